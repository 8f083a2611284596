"""The commands: functions for notebooks and scripts, which `photonpano` exports, and what the program prints of them."""
