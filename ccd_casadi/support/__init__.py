"""What every package uses: errors, options of commands, processes, progress, units."""
