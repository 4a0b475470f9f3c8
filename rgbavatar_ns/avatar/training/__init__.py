"""How an avatar learns: the step, the loop, losses and first colours."""
