"""Controllers in the form that an industrial drive accepts: a cascade with its filters, rounded as
the drive rounds, judged and proven as it runs. Nothing below the commands imports this room."""
