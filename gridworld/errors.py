"""The one exception for what a user got wrong."""


class InputError(ValueError):
    """A mistake in a map, a setting, an action or a file, told in one sentence.

    The sentence names the thing, where it is, and what would be right. Command lines print it without a
    traceback and exit with `EXIT_CODE`.
    """


EXIT_CODE = 2
