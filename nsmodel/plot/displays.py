"""What results show of themselves: methods of results find it here by its name (`_utils.display`).

Pictures and pages are imported when they are asked for: who draws a run needs no sweeps.
"""

from nsmodel._utils import lazy_attributes

DISPLAYS = {
    "nsmodel.plot.figures": ["overview"],
    "nsmodel.plot.film": ["animate"],
    "nsmodel.plot.html.notebook": [
        "model_html",
        "report_html",
        "run_html",
        "sensitivity_html",
        "statistics_html",
        "stress_html",
        "study_html",
        "sweep_html",
    ],
    "nsmodel.plot.html.report_page": ["write_report_page"],
    "nsmodel.plot.html.run_page": ["write_run_page"],
    "nsmodel.plot.html.study_page": ["write_study_page"],
    "nsmodel.plot.sensitivity": ["sensitivity"],
    "nsmodel.plot.study": ["stress", "work_precision"],
    "nsmodel.plot.sweep": ["draw_variable"],
}

lazy_attributes(__name__, DISPLAYS)
