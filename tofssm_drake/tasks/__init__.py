"""What the arm does and carries."""
