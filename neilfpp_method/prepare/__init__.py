"""From a folder of photographs to a capture: structure from motion, undistortion, scene box, oriented points."""
