import pyrcal

# an RTC whose slopes have x and y exchanged, and Sy of the other sign
orientation = pyrcal.Orientation(swap_xy=True, sign_y=-1)
print(orientation)
