"""``pyrcal demo``: the main job from end to end, and an honest verdict on it.

Starts the service and, as another process, a simulated RTC with a mis-registration the service
does not know; shows what an operator would see over REST; at the end compares with the truth,
which the simulator wrote to a file and never sent.
"""
