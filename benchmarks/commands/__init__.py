"""The subcommands of `oed`, one file each: HELP, EXAMPLE, configure(parser), run(args)."""
