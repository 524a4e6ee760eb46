"""Stage 4: run records in; tables and learning curves out. It needs neither torch nor a simulator."""
