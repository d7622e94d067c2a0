"""Time series of a machine, in open or closed loop, and the plant's frequency response of them."""
