"""The paper: its systems, and every figure of it."""
