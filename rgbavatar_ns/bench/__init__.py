"""How fast the project is on this machine: workloads, timing, rooflines, what runs beside it."""
