"""Suites: whole studies as one command. A suite is a short TOML file; it becomes jobs, which the stages do."""
