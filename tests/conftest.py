"""Settings of all tests: what hypothesis may take does not depend on how loaded the machine is."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

settings.register_profile("mlbatch", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("mlbatch")
