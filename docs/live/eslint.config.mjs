import js from "@eslint/js";

const browser =
  "window document navigator location performance matchMedia getComputedStyle devicePixelRatio " +
  "requestAnimationFrame setTimeout clearTimeout setInterval clearInterval addEventListener console atob URL Image Option " +
  "MessageChannel MutationObserver ResizeObserver TextDecoder HTMLElement ImageData";

export default [
  js.configs.recommended,
  {
    languageOptions: {
      sourceType: "script", // an ES module does not load from the disk
      globals: {
        stad: "writable",
        ...Object.fromEntries(browser.split(" ").map((name) => [name, "readonly"])),
      },
    },
  },
];
