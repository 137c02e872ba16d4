"""The comparison: campaigns, tables, figures, the report and the command line."""
