"""Whether an RTC keeps the contract: each thing that docs/rtc.md asks, looked at by itself."""
