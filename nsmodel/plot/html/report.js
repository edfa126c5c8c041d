// The page of a report: findings with their verdicts, what follows, notes.

const SIGNS = { holds: "✓", sampled: "≈", violated: "✗", unknown: "?" };

const data = JSON.parse(document.getElementById("data").textContent);

const badge = (verdict) => element("span", `badge verdict ${verdict}`, `${SIGNS[verdict] ?? ""} ${verdict}`);

/** A finding or a consequence: verdict, name, statement, and lines below. */
function card({ name, verdict, statement, lines, source }) {
  const text = element("div", "", "", element("strong", "", name), " ", element("span", "", statement));
  return element(
    "article",
    `card ${verdict}`,
    "",
    badge(verdict),
    element("div", "", "", text, ...lines.map((words) => element("p", "told", words)), element("p", "note", source)),
  );
}

const cards = data.findings.map(card);
const counts = new Map();
for (const { verdict } of data.findings) counts.set(verdict, (counts.get(verdict) ?? 0) + 1);
const filters = [...counts].map(([verdict, count]) =>
  toggle(`${SIGNS[verdict] ?? ""} ${verdict}: ${count}`, true, (now) => {
    data.findings.forEach((finding, k) => {
      if (finding.verdict === verdict) cards[k].hidden = !now;
    });
  }),
);
const facts = element("dl");
for (const [label, lines] of data.facts)
  facts.append(element("dt", "", label), ...lines.map((words) => element("dd", "", words)));
document
  .getElementById("page")
  .append(
    element("h1", "", data.title),
    facts,
    element("nav", "chips", "", ...filters),
    element("section", "cards", "", ...cards),
  );
if (data.consequences.length) {
  document
    .getElementById("page")
    .append(element("h2", "head", "What follows"), element("section", "cards", "", ...data.consequences.map(card)));
}
document.getElementById("page").append(...data.notes.map((words) => element("p", "note", words)));
