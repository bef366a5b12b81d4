"""Effects of camera and light on a simulated photo: one effect, one file, one pure function.

`settings.py` holds the settings of each, `photo_random.py` the random numbers of a photo, and
`simulate/render.py` the order. An effect that the spec does not name is not called.
"""
