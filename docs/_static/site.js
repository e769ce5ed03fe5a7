// What every page needs: keys scroll whatever is wider than the page, and films can pause.

const SCROLLING = "article pre, article .table-wrapper, article .cell_output table, article .math";
const FILMS = 'article img[src$=".gif"], article img[src^="data:image/gif"]';

/** Let the focus reach each block that scrolls, and no other: arrow keys then move it. */
function letKeysScroll() {
  for (const block of document.querySelectorAll(SCROLLING)) {
    if (block.scrollWidth > block.clientWidth + 1) block.tabIndex = 0;
    else block.removeAttribute("tabindex");
  }
}

/** Add a button that stops a film at its first picture; it begins stopped if `paused`. */
function addPause(film, paused) {
  const tags = ["span", "canvas", "button"];
  const [box, still, button] = tags.map((tag) => document.createElement(tag));
  still.width = film.naturalWidth;
  still.height = film.naturalHeight;
  still.getContext("2d").drawImage(film, 0, 0); // of a film this draws the first picture
  still.setAttribute("role", "img");
  still.setAttribute("aria-label", film.alt);

  function pause(now) {
    [film.hidden, still.hidden] = [now, !now];
    button.textContent = now ? "▶ Play" : "❚❚ Pause";
    button.setAttribute("aria-label", now ? "Play the film" : "Pause the film");
  }
  button.onclick = () => pause(!film.hidden);
  button.type = "button";
  box.className = "film";
  film.replaceWith(box);
  box.append(film, still, button);
  pause(paused);
}

addEventListener("load", () => {
  const { matches: paused } = matchMedia("(prefers-reduced-motion: reduce)");
  for (const film of document.querySelectorAll(FILMS)) addPause(film, paused);
  document.querySelector(".toc-drawer")?.setAttribute("aria-label", "On this page");
  letKeysScroll();
  window.MathJax?.startup?.promise?.then(letKeysScroll); // formulas get their width late
});
addEventListener("resize", letKeysScroll);
