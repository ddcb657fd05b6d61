"""Run the training scripts of other projects in this process: launcher, gate states, and CUDA on the CPU."""
