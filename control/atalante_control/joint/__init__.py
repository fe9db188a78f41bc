"""Control of single joints: PID, joint idealization, flat foot and haptics."""
