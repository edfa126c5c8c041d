"""Results as HTML: files that stand alone, without server, network or other file, and displays of notebooks, without a script.

A page is a title, a document of plain data (`page`, which writes numbers as text, of long runs their extremes), a style sheet and
scripts; `run_page`, `report_page` and `study_page` say what is shown of each result. `notebook` has a function for each result,
made of `elements`. The scripts draw on canvases: `data.js` (numbers and pyramids), `elements.js`, `axes.js`, `curves.js` (what of
a column is drawn), `panels.js` (over time), `plane.js` (a canvas that is moved), `pictures.js` (phase plane, configuration),
`view.js` (the page of a run, its pointer and its keys), `report.js`, `study.js`.
"""
