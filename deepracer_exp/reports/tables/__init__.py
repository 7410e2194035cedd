"""A log as `log_view.LogView` and what is computed of it: columns, tables, statistics."""
