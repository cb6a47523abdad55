// @ts-check
/* Types of the panels and of what they share. */

/** @typedef {import("./run_rows.js").OpenRun} OpenRun */
/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("/static/theme.js").Theme} Theme */

/** A part of the page. It subscribes to its own events; the page calls these methods of all panels.
 *
 * @typedef {object} Panel
 * @property {() => Command[]} [commands] its keys
 * @property {() => AddressPart[]} [address] its part of the page's address
 * @property {() => Figure[]} [figures] its views that can be saved as an image
 * @property {(run: OpenRun) => void} [showRun] another run was opened
 * @property {(frame: FrameView) => void} [showFrame] another frame is shown
 * @property {(state: StateView) => void} [showState] the selection or the display settings changed
 * @property {() => void} [showTheme] the theme changed
 * @property {(view: import("./views.js").View) => void} [showView] another view of the page is shown
 * @property {() => void} [showTabs] another tab is shown
 * @property {() => void} [showRefusal] the server refused a request
 * @property {(position: number) => void} [pointAt] the page goes to a frame that has not arrived
 * @property {() => void} [imagePainted] the image panel was painted
 */

/** A value of the page's address: its initial value, and a test of other texts.
 *
 * @typedef {{initial: string | null, accepts: (text: string) => boolean}} Field
 */

/** Values of the address that are set together, by name. `set` gets texts that the fields accept.
 *
 * @typedef {object} AddressPart
 * @property {{[name: string]: Field}} fields
 * @property {() => {[name: string]: string | null}} get
 * @property {(values: {[name: string]: any}) => void} set
 */

/** A view that can be saved as an image, with its size in CSS pixels. The page draws it, or the
 * server renders it, as PNG only.
 *
 * @typedef {object} Figure
 * @property {string} name
 * @property {string} title
 * @property {number} width
 * @property {number} height
 * @property {(context: Context, options: FigureOptions) => void} [draw]
 * @property {(scale: number) => Promise<Blob>} [render]
 * @property {boolean} [hasPhoto]
 * @property {boolean} [hasLegend]
 */

/** @typedef {{format: "png" | "svg", scale: number, theme: Theme, photo: boolean, legend: boolean}} FigureOptions */

/** A canvas context, or the SvgContext of a figure.
 *
 * @typedef {CanvasRenderingContext2D} Context
 */

/** An element in an image: the anchor and, for a pole, the end.
 *
 * @typedef {[Point, Point | null]} Ends
 */

/** @typedef {{shape: import("/static/glyphs.js").Shape, color: string}} ClassStyle */
/** @typedef {Map<number, ClassStyle>} ClassMap by the class's id */

export {};
