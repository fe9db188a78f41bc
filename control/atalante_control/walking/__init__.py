"""Walk on the ground: detect contact of the swing foot."""
