import pyrcal


def show_registration(url="http://127.0.0.1:8080"):
    """Print what a running service knows."""
    service = pyrcal.Service(url)
    state = service.get("/v1/state").document
    print(state["registration"])
