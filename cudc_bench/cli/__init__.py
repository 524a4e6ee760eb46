"""The command line: its application, the options that commands share, and the commands that belong to no stage."""
