from pyrcal import rtc

router = rtc.Router(endpoint="tcp/127.0.0.1:7447")
print(router.endpoint)
