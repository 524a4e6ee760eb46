"""What is taken in: records, those that somebody hands in, and which stored datasets a command is about."""
