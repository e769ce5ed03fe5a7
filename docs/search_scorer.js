// How Sphinx ranks what a search finds: its own numbers, but pages come before the reference.
var Scorer = {
  score: ([docname, , , , score]) => (docname.startsWith("docs/modules/") ? score - 100 : score),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
