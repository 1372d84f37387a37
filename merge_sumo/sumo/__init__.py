"""SUMO as the host: the only part of the project that imports libsumo or sumo."""
