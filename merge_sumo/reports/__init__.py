"""Pages, figures, tables, and files for other tools: read from files, nothing is simulated."""
