"""How long a user waits for advice."""

import time


class Patience:
    """Seconds after which no further run is begun."""

    seconds: float
    begun: float

    def __init__(self, seconds: float) -> None:
        self.seconds, self.begun = seconds, time.perf_counter()

    @property
    def over(self) -> bool:
        return time.perf_counter() - self.begun > self.seconds
