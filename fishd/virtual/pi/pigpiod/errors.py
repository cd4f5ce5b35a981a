"""Error numbers of pigpio that the emulated pigpiod returns."""

BAD_USER_GPIO = -2
BAD_MODE = -4
BAD_LEVEL = -5
BAD_PULSEWIDTH = -7
BAD_DUTYCYCLE = -8
BAD_HANDLE = -25
NOT_PERMITTED = -41
BAD_SCRIPT_ID = -48
DUP_TAG = -53
BAD_SCRIPT_CMD = -55
NO_SCRIPT_ROOM = -57
TOO_MANY_PARAM = -61
SCRIPT_NOT_READY = -62
BAD_TAG = -63
BAD_MILS_DELAY = -65
UNKNOWN_COMMAND = -88
NOT_PWM_GPIO = -92
NOT_SERVO_GPIO = -93
NOT_HPWM_GPIO = -95
BAD_HPWM_FREQ = -96
BAD_HPWM_DUTY = -97


class PigpioError(Exception):
    """Error of a command; `number` is the result that the client receives."""

    def __init__(self, number: int) -> None:
        super().__init__(f"pigpio error {number}")
        self.number = number


def check(good: bool, error: int) -> None:
    """Raise a `PigpioError` unless `good`."""
    if not good:
        raise PigpioError(error)
