"""Operations with exclusive use of the loop or mirror, one module each.

Acquisition, measurement of a matrix, probation. Each is a record of the state
and the functions that advance it by an event. The table of ``service.tracker`` processes an event
first, so that an operation sees the state after it. Orders that are permitted during an operation
are in ``tracking.interlocks``.
"""
