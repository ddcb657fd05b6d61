"""Says, from half a minute of training, how long whole runs will take, how many Gaussians and how much memory."""
