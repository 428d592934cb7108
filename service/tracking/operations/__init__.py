"""Operations that have the loop or the mirror to themselves, one module each.

Acquisition, the RTC's measurement, a noisy measurement, probation: each is a record of the state
and the functions that take it further with an event. What is heard is taken in by the table of
``service.tracker`` first, so that an operation decides on the state after it. Which orders go
beside one is in ``tracking.interlocks``.
"""
