"""What each kind of event does to the state; ``service.tracker`` hands them out."""
