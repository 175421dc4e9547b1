"""Kernels for NVIDIA GPUs, written in Warp. Imported only where they run."""

import warp as wp

if wp.config.log_level == wp.LOG_INFO:  # Warp's default announces each kernel between the lines of a command
    wp.config.log_level = wp.LOG_WARNING
