"""Training scripts of others, run in this process: the launcher, their checkpoints, CUDA redirected to the CPU."""
