"""Parts of a run: rig (HAL on its bus), emulated body, pendant, run folder and figures."""
