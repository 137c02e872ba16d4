"""The subcommands of `oed`, one file each: HELP, EXAMPLE, configure(parser), run(args)."""


def natural(text: str) -> int:
    """An argument that counts: a seed, a replicate."""
    value = int(text)
    if value < 0:
        raise ValueError
    return value
