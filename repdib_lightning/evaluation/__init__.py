"""What a representation kept and dropped."""
