"""The default masks on an accelerator: the host path's mathematics in torch, without reads on the host.

`DeviceMasks` takes the place of `HostMasks`. What `renew` calls reads no value back, so its shapes and the
number of its launches depend on sizes alone; set-up, checkpoints and pictures may read. Every function is
tested against its numpy or OpenCV counterpart.
"""
