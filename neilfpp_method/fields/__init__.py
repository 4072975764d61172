"""The four fields of the method and the background, and the encodings and networks they are made of (METHOD
§5).
"""
