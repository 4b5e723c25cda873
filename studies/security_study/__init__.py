"""What security costs, and how fast it acts."""
