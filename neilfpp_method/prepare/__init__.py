"""From a folder of photographs to a capture: brackets, structure from motion, scene box, oriented points."""
