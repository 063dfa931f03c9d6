"""Every sentence about the numbers of certificates: ``statements``, ``verdicts``, and ``withdrawals`` of bounds."""
