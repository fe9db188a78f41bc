"""Walking on the ground: contact detection of the swing foot."""
