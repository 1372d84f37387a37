"""What people see: verdicts, pages, figures, tables, files for other tools."""
