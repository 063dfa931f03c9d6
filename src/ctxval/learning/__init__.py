"""What executions teach about the system."""
