import js from "@eslint/js";

const browser =
  "window document navigator location performance matchMedia getComputedStyle devicePixelRatio " +
  "requestAnimationFrame setTimeout clearTimeout setInterval clearInterval addEventListener console atob URL Image Option " +
  "MessageChannel MutationObserver ResizeObserver TextDecoder HTMLElement ImageData " +
  "IntersectionObserver PointerEvent URLSearchParams TextEncoder Blob Response DecompressionStream WebAssembly " +
  "Worker WorkerGlobalScope self postMessage localStorage history crypto btoa Path2D HTMLInputElement";

export default [
  js.configs.recommended,
  {
    languageOptions: {
      sourceType: "script", // an ES module does not load from the disk
      globals: {
        stad: "writable",
        onmessage: "writable", // of a worker
        ...Object.fromEntries(browser.split(" ").map((name) => [name, "readonly"])),
      },
    },
  },
];
