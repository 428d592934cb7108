"""Operations with exclusive use of the loop or mirror, one module each.

Acquisition, measurement of a matrix, probation. Each is a record of the state, reactions to events
(``on_...``), and an ``advance`` that takes it further by what the state says after any event. The
tables of ``service.tracker`` name both. Orders that are permitted during an operation are in
``tracking.interlocks``.
"""
