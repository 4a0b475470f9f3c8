"""How an avatar is kept: bundle, reference to a head, statistics of training."""
