"""Stage 4: run records in; tables, statistics and figures out. It needs neither torch nor a simulator."""
