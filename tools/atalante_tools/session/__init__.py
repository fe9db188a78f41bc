"""Parts of a run: HAL with its buses, emulated body, pendant, run folder and figures."""
