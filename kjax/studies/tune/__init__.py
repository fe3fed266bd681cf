"""The controller tuned by gradients through its closed loop, and the verdict of MuJoCo."""
