// Weights of the search: guides come before module pages, and headings before text.
var Scorer = {
  score: ([page, , , , score, , kind]) =>
    score +
    (kind === "title" ? 10 : 0) -
    (page.startsWith("reference/") && kind !== "object" ? 20 : 0) -
    (["changes", "glossary", "report"].includes(page) ? 5 : 0),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
