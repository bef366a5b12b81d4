"""What a real camera and a real day do to a photo: one effect, one file, one pure function.

`settings.py` says what a spec may ask for, `moment.py` what differs from photo to photo, and
`simulate/develop.py` in which order they act. What a spec does not name is not called.
"""
