"""The commands, one file per family: each parses, calls one function, and prints."""
