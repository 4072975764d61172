"""Files in: images, arrays, JSON and paths from untrusted sources are checked before they are used."""
