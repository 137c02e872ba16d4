// What the theme leaves out for whoever reads by keyboard or by ear: names of its two asides, and a way into what scrolls.
addEventListener("DOMContentLoaded", () => {
  document.querySelector("aside.sidebar-drawer")?.setAttribute("aria-label", "Pages of this site");
  document.querySelector("aside.toc-drawer")?.setAttribute("aria-label", "Sections of this page");
  for (const block of document.querySelectorAll(".highlight pre, .table-wrapper, .math-display")) block.tabIndex = 0;
});
