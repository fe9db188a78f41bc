"""Control of the joints: PID, idealization, flat foot and haptics."""
