"""The viewer in the browser. Only `browser` knows viser; the rest works and is tested without it."""
