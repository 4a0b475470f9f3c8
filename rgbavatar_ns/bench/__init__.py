"""How fast the project is on this machine: workloads, timing, floors and peers."""
