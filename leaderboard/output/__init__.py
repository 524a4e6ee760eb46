"""How a report's files are made, and made again only where something changed."""
