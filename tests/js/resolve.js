// Lets node resolve the pages' absolute imports: `/static/` is what the server serves from there.
import { register } from "node:module";

const STATIC = new URL("../../semviz/web/static/", import.meta.url).href;
const hooks = `export function resolve(specifier, context, next) {
  return next(specifier.replace(/^\\/static\\//, ${JSON.stringify(STATIC)}), context);
}`;
register(`data:text/javascript,${encodeURIComponent(hooks)}`);
