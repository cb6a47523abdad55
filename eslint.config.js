import globals from "globals";

const rules = {
  eqeqeq: "error",
  "no-undef": "error",
  "no-unused-vars": ["error", { argsIgnorePattern: "^_", destructuredArrayIgnorePattern: "^_", ignoreRestSiblings: true }],
  "no-use-before-define": ["error", { functions: false, classes: false, variables: false }],
};

export default [
  { ignores: ["node_modules/", ".venv/", "**/*.d.ts"] },
  { files: ["semviz/**/*.js"], languageOptions: { globals: globals.browser }, rules },
  { files: ["tests/js/**/*.js", "eslint.config.js"], languageOptions: { globals: globals.node }, rules },
];
