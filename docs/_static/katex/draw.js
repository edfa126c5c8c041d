// Draws the formulas of a page, and those in what cells of notebooks show.
document.addEventListener("DOMContentLoaded", () => {
  const delimiters = [
    { left: "$$", right: "$$", display: true },
    { left: "\\[", right: "\\]", display: true },
    { left: "\\(", right: "\\)", display: false },
    { left: "$", right: "$", display: false },
  ];
  for (const element of document.querySelectorAll(".math, .cell_output")) {
    const own = element.classList.contains("math") ? delimiters.slice(0, 3) : delimiters;
    renderMathInElement(element, { delimiters: own, throwOnError: false, trust: false });
  }
});
