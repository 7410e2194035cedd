"""Tables of logs and runs, findings in them, charts, and the pages that show them.

`tables.log_view.prepare` makes a `LogView` of a recording; `findings.findings` and the functions of `charts` read it,
`pages.log_report.write_log_page` shows it. `pages.run_page.RunReport` reports a training as it ends.
"""
