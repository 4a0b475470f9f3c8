"""The CPU backend: C++17, one copy of its loops per instruction set."""
