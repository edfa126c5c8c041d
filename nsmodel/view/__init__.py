"""Results as one HTML file each, which stands alone: no server, no network, no other file.

A page is a title, a document of plain data (`page`), a style sheet and scripts. `run`, `report` and `study` say what is
shown of each result; `columns` and `scene` read it off a run; `packed` writes numbers as text, of long runs their extremes. The
scripts draw on canvases: `data.js` (numbers and pyramids), `elements.js`, `axes.js`, `curves.js` (what of a column is drawn),
`panels.js` (over time), `plane.js` (a canvas that is moved), `pictures.js` (phase plane, configuration), `view.js` (the page of a
run, its pointer and its keys), `report.js`, `study.js`.
"""
