"""Check whether an RTC keeps the contract of docs/rtc.md."""
