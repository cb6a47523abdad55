// @ts-check
/* The open run, with a row for each frame made of the columns that arrive. */

/** @typedef {import("/static/protocol").inspector.FrameColumns} FrameColumns */
/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.RunView} RunView */
/** @typedef {Pick<FrameView, "index" | "status" | "reason" | "diagnosis" | "noticed" | "overconfident" | "error_m" | "error_deg" | "ms">} FrameRow a frame in lists */
/** @typedef {FrameRow & {position: number}} PlacedRow a frame at its position in the run */
/** @typedef {Omit<RunView, "frames"> & {frames: PlacedRow[]}} OpenRun */

/**
 * @param {RunView} run
 * @returns {OpenRun}
 */
export function openRun(run) {
  return { ...run, frames: frameRows(run.frames) };
}

/**
 * @param {FrameColumns} columns
 * @returns {PlacedRow[]}
 */
function frameRows({ index, status, statuses, texts, reason, diagnosis, noticed, overconfident, error_m: errorM, error_deg: errorDeg, ms }) {
  const rows = index.map((number, position) => ({
    position,
    index: number,
    status: /** @type {FrameRow["status"]} */ (statuses[status[position]]),
    reason: texts[reason[position]],
    diagnosis: texts[diagnosis[position]],
    noticed: texts[noticed[position]],
    overconfident: false,
    error_m: errorM[position],
    error_deg: errorDeg[position],
    ms: ms[position],
  }));
  for (const position of overconfident) rows[position].overconfident = true;
  return rows;
}
