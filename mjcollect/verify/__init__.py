"""This room holds the judge of recorded flights, which shares no code with what flies them."""

from mjcollect.verify.fleet import Encounter, least_gaps, verify_fleet, verify_separation
from mjcollect.verify.flight import (
    DISTURBED_MARGIN,
    DISTURBED_REST,
    Violation,
    verify,
    verify_run,
)

__all__ = [
    "DISTURBED_MARGIN",
    "DISTURBED_REST",
    "Encounter",
    "Violation",
    "least_gaps",
    "verify",
    "verify_fleet",
    "verify_run",
    "verify_separation",
]
