"""Light that is solved for: what surfaces send is linear in an environment map and in the lamps before it."""
