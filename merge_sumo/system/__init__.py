"""The machine: folders, processes, signals, and what may be trusted."""
