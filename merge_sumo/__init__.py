"""merge-sumo: an interaction-aware testbed for merging controllers, hosted in SUMO."""
