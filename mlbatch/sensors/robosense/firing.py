"""When the channels of ROBOSENSE models fire after their round begins, ns, where no rule tells it.

Source: facts/robosense.md section 5. For the 80- and 48-line models it names the maker's driver:
rs_driver, `decoder_RS80.hpp`, `decoder_RS48.hpp`, `decoder_RSP80.hpp`, `decoder_RSP48.hpp`.
"""

from __future__ import annotations


def _ns(times_us: str) -> tuple[int, ...]:
    """Times in us as ns; `t*n` stands for n channels that fire at t."""
    found: list[int] = []
    for text in times_us.split():
        time, _, count = text.partition("*")
        found += [round(float(time) * 1000)] * int(count or 1)
    return tuple(found)


def _each(times_us: str, channels: int) -> tuple[int, ...]:
    """As many channels at each time."""
    return _ns(" ".join(f"{time}*{channels}" for time in times_us.split()))


def _steps(counts: str) -> tuple[int, ...]:
    """Ruby: groups of channels 3.236 us apart, of so many channels."""
    return tuple(3236 * group for group, count in enumerate(counts) for _ in range(int(count)))


BPEARL_V4 = _ns(
    "0 1.67 3.34 5.00 6.67 8.34 10.01 11.68 13.34 15.01 16.68 18.35 20.02 21.68 23.35 25.02 "
    "26.69 28.36 30.02 31.69 33.36 35.03 36.70 38.36 40.03 41.70 43.37 45.04 46.70 48.37 50.04 "
    "51.71"
)
_AIRY_NORMAL = "0 5.712 12.376 19.040 25.704 33.320 41.888 50.456 59.024 70.448 81.872 93.296"
_AIRY_SIDE = "0 11.424 22.848 34.272 45.696 54.264 62.832 71.400 79.016 85.680 92.344 99.008"
_AIRY_M = "0 7.616 16.184 24.752 33.320 42.840 52.360 61.880 71.400 79.968 88.536 97.104"
RUBY_PLUS_128 = _ns(
    "0*4 1.13*4 2.13*4 3.26*4 4.26*4 5.38*4 6.38*4 7.51*4 8.51*4 10.01*4 11.38*4 13.31*4 15.11*4 "
    "17.04*4 18.85*4 21.14*5 23.31*4 25.61*4 27.78*4 30.07*4 32.24*4 34.54*4 36.70*4 38.64*4 "
    "40.44*4 41.94*4 43.30*4 44.80*4 46.17*4 47.66*4 49.03*4 50.53*2 53.771"
)
RUBY_PLUS_80 = _ns(
    "0*4 1.217*4 2.434*2 3.652*3 4.869*2 6.086*2 7.304*2 8.521*2 9.739*2 11.323*2 12.907*2 "
    "14.924*2 16.941*4 18.959*4 20.976*4 23.127*4 25.278*4 27.428*4 29.579*4 31.963*4 34.347*4 "
    "36.498*4 38.648*2 40.666*2 42.683 50.603 52.187*3 53.771*2"
)
_RUBY_PLUS = (
    "0 1.217 2.434 3.652 4.869 6.086 7.304 8.521 9.739 11.323 12.907 14.924 16.941 18.959 20.976 "
    "23.127 25.278 27.428 29.579 31.963"
)
_RUBY_PLUS_LONG = _RUBY_PLUS + " 34.347 36.498 38.648 40.666"
RUBY_80 = _steps("3243333222222223") + _steps("3332423322232123")
RUBY_48 = _steps("1111222211112222") * 2
AIRY_96 = (_each(_AIRY_NORMAL, 8), _each(_AIRY_SIDE, 8), _each(_AIRY_M, 8))
AIRY_48 = _each(_AIRY_M, 4)
RUBY_PLUS_80V = _each(_RUBY_PLUS, 4)
RUBY_PLUS_48 = _each(_RUBY_PLUS_LONG, 2)
