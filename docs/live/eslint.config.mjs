import js from "@eslint/js";
import globals from "globals";

export default [
  js.configs.recommended,
  {
    languageOptions: {
      sourceType: "script", // an ES module does not load from the disk
      globals: {
        stad: "writable",
        ...globals.browser,
        ...globals.worker,
      },
    },
    rules: { "max-len": ["error", 100] },
  },
];
