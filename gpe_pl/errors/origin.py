"""Where an error comes from."""

import traceback


def came_through(error: BaseException, module: str) -> bool:
    """Return whether a function of a module, or of the modules of a package, was running when the error was raised."""
    names = (frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__))
    return any(name == module or name.startswith(f"{module}.") for name in names)
