// Written by `python -m semviz.web.protocol --jsdoc` from the messages of both tools.
// Change those, not this file.

/** A refused request, or a failure in the server; ``text`` is shown to the user. */
export interface ErrorEvent {
  type: "error";
  reply_to: string | null;
  code: "not_saved" | "conflict" | "replaced" | "invalid" | "not_found" | "busy" | "internal";
  text: string;
  retry: boolean;
}

/** The first event on every connection. */
export interface HelloEvent {
  type: "hello";
  reply_to: string | null;
  protocol: 3;
  session: string;
}

export namespace annotator {
/** Accept proposals as the page showed them, all or none, but those that somebody else labelled meanwhile. */
export interface AcceptEdit {
  kind: "accept";
  marks: Array<DrawnMark>;
}

/** Accept the review of a frame as it is. The row stays as it is, and the operation becomes its last writer: whoever reviews the frame anew takes the acceptance away. */
export interface AcceptFrame {
  frame_index: number;
  kind: "accept frame";
}

/** Accept all sure tracks; ``count`` is their number as the page showed it. */
export interface AcceptSureTracksEdit {
  kind: "accept sure tracks";
  count: number;
}

/** Accept tracks of detections in all their images, with corrections of single marks. */
export interface AcceptTracksEdit {
  kind: "accept tracks";
  track_ids: Array<string>;
  corrections?: Array<CorrectedMark>;
}

/** Add several observations, all or none. An observation of an element that an earlier one creates has ``class_id`` None. */
export interface AddMany {
  observations: Array<AddObservation>;
  kind: "add many";
}

/** Add an observation of an existing element or, if ``class_id`` is set, of a new one. */
export interface AddObservation {
  observation_id: string;
  element_id: string;
  frame_index: number;
  side: "left" | "right";
  anchor_px: [number, number];
  end_px?: [number, number] | null;
  anchor_known?: boolean;
  end_known?: boolean;
  class_id?: number | null;
  kind: "add";
}

/** How the labels of two people agree, in frames that both have reviewed. */
export interface AgreementView {
  frames: number;
  elements: number;
  both: number;
  missed: [number, number];
  other_class: number;
  labels: number;
  same_ends: number;
  identical: number;
  pole_angle_deg: Array<number>;
  pole_px: Array<number>;
  sign_px: Array<number>;
}

/** Move the labels of an element to where its labels in the frame on screen put them. */
export interface AlignLabelsEdit {
  kind: "align labels";
  element_id: string;
  frame_index: number;
}

/** A possible review decision, and its edit. */
export interface AnswerView {
  name: string;
  title: string;
  edit: AddObservation | AddMany | Dismiss | MoveObservation | ReSnap | SetKnown | SetKnownOfMany | SwapEnds | DeleteObservation | DeleteMany | DeleteElement | Link | Unlink | SetClass | SetClassOfMany | SetClassOfViews | SetAttribute | ReviewFrame | AcceptFrame | SendBackFrame | DecideElements | RevokeDecision | DeleteNote;
}

/** Apply an edit; its ``id`` is stored, so a request that is sent twice is applied once. */
export interface ApplyEditRequest {
  type: "apply_edit";
  id: string;
  edit: DrawEdit | AcceptEdit | MergeFrameEdit | AcceptTracksEdit | RejectTracksEdit | AcceptSureTracksEdit | AlignLabelsEdit | NoteEdit | UndoEdit | RedoEdit | NameEdit | RestoreEdit | AddObservation | AddMany | Dismiss | MoveObservation | ReSnap | SetKnown | SetKnownOfMany | SwapEnds | DeleteObservation | DeleteMany | DeleteElement | Link | Unlink | SetClass | SetClassOfMany | SetClassOfViews | SetAttribute | ReviewFrame | AcceptFrame | SendBackFrame | DecideElements | RevokeDecision | DeleteNote;
  base?: EditBase | null;
}

/** Assign a range of frames to a person; without one, take all of them away. */
export interface AssignFramesRequest {
  type: "assign_frames";
  id: string;
  person: string;
  frames: [number, number] | null;
}

/** Let two people label a share of a range of frames, each without seeing the other's labels. */
export interface AssignShareRequest {
  type: "assign_share";
  id: string;
  frames: [number, number];
  percent: number;
  people: [string, string];
}

/** What the values of an attribute are; those of attributes without one are texts. */
export interface AttributeType {
  name: string;
  type: "text" | "number" | "flag" | "choice";
  choices: Array<string>;
}

/** Whether there is a backdrop to show; if not, ``note`` says why and what to do. */
export interface BackdropEvent {
  type: "backdrop";
  reply_to: string | null;
  available: boolean;
  note: string;
}

/** Build the map. */
export interface BuildMapRequest {
  type: "build_map";
  id: string;
}

/** The numbers of one element; None for unknown ones. */
export interface Card {
  views: number;
  reason: string | null;
  depth_m: number | null;
  depth_sigma_m: number | null;
  angle_deg: number | null;
  is_thin: boolean;
  rms_px: number | null;
  height_m: number | null;
  height_sigma_m: number | null;
  length_px: Partial<Record<"left" | "right", number>>;
  epipolar_px: number | null;
  smaller_views: number;
}

/** Choose what to do with the poses of a stretch; its ``id`` is stored, so a request that is sent twice is applied once. */
export interface ChoosePosesRequest {
  type: "choose_poses";
  id: string;
  choice: "refine" | "leave out" | "keep" | "ask";
  first: number;
  last: number;
  subject: "frames" | "axes" | "time" | "heights" | "baseline" | "right image";
}

/** Close the open entry. */
export interface CloseReviewRequest {
  type: "close_review";
  id: string;
}

/** One element of a frame, as two people labelled it. */
export interface ComparedElement {
  id: string;
  names: [string, string];
  classes: [number | null, number | null];
  views: Array<ComparedView>;
  apart: string;
}

/** Two versions of a frame, what differs most first. */
export interface ComparedEvent {
  type: "compared";
  reply_to: string | null;
  frame: number;
  people: [string, string];
  times: [string, string];
  is_blind: boolean;
  elements: Array<ComparedElement>;
}

/** One element in one image, as two people labelled it, and the mean if there is one. */
export interface ComparedView {
  side: "left" | "right";
  first: ObservationView | null;
  second: ObservationView | null;
  mean: ObservationView | null;
  px: number | null;
  angle_deg: number | null;
}

/** An edit would overwrite what others did since; it is applied if it knows ``overwritten``. */
export interface ConflictEvent {
  type: "error";
  reply_to: string | null;
  code: "conflict";
  text: string;
  retry: boolean;
  overwritten: Array<string>;
  is_deleted: boolean;
  operation: number;
  author: string;
  time: string;
}

/** The ends by which a person replaced those of a detection. */
export interface CorrectedMark {
  observation_id: string;
  anchor_px: [number, number];
  end_px?: [number, number] | null;
}

/** Add review decisions, all or none; every later map build follows them. */
export interface DecideElements {
  judgements: Array<ReviewDecision>;
  kind: "judge";
}

/** Delete an element with its observations and all that refers to it. */
export interface DeleteElement {
  element_id: string;
  kind: "delete element";
}

/** Delete several observations, all or none, each like ``DeleteObservation``. */
export interface DeleteMany {
  observation_ids: Array<string>;
  kind: "delete many";
}

/** Delete a note: the question is answered. */
export interface DeleteNote {
  note_id: string;
  kind: "delete note";
}

/** Delete one observation; deleting the last one deletes its element. */
export interface DeleteObservation {
  observation_id: string;
  kind: "delete";
}

/** How far a detector and the labels of one frame disagree. */
export interface Disagreement {
  new: number;
  missed: number;
  weight: number;
  worst_id: string | null;
}

/** Dismiss proposals, all or none. */
export interface Dismiss {
  dismissals: Array<Dismissal>;
  kind: "dismiss";
}

/** A proposal that a person rejected in one image. */
export interface Dismissal {
  id: string;
  frame_index: number;
  side: "left" | "right";
  why: "rejected" | "occluded" | "absent";
  element_id: string | null;
}

/** Guides and numbers of a draft. */
export interface DraftPreview {
  guides: Partial<Record<"left" | "right", Array<Guide>>>;
  card: Card | null;
  snapped: SnappedMark | null;
  joins: string | null;
  warning: string;
}

/** Guides and numbers of a draft. */
export interface DraftPreviewEvent {
  type: "draft_preview";
  reply_to: string | null;
  preview: DraftPreview;
}

/** The selected or drawn element, for which the page requests guides and numbers. */
export interface DraftState {
  frame_index: number;
  selected_id?: string | null;
  is_chosen?: boolean;
  side?: "left" | "right";
  second?: number | null;
  drawing?: ElementDraft | null;
  moved?: Record<string, [[number, number], [number, number] | null]>;
}

/** A mark that a person corrected in the strip, in an image of its frame. */
export interface DraggedMark {
  frame: number;
  side: "left" | "right";
  anchor: [number, number];
  end: [number, number] | null;
  anchor_known: boolean;
  end_known: boolean;
}

/** Draw a mark; it joins the element ``selected_id`` if it fits or was chosen. */
export interface DrawEdit {
  observation_id: string;
  element_id: string;
  frame_index: number;
  side: "left" | "right";
  second?: number | null;
  anchor_px: [number, number];
  end_px?: [number, number] | null;
  anchor_known?: boolean;
  end_known?: boolean;
  class_id?: number | null;
  kind: "draw";
  selected_id?: string | null;
  is_chosen?: boolean;
  asks_same?: boolean;
  snap?: boolean;
  asks_bottom?: boolean;
}

/** A mark on a pane, of element ``element_id``. With a ``class_id`` it starts that element, unless it fits an existing one. */
export interface DrawnMark {
  observation_id: string;
  element_id: string;
  frame_index: number;
  side: "left" | "right";
  second?: number | null;
  anchor_px: [number, number];
  end_px?: [number, number] | null;
  anchor_known?: boolean;
  end_known?: boolean;
  class_id?: number | null;
}

/** One check, as texts for people. */
export interface DriveCheck {
  kind: "mosaic" | "colors" | "sides" | "lines" | "rows" | "poses" | "mount" | "extrinsics" | "scale" | "time" | "steps" | "gaps";
  name: string;
  measured: string;
  value: string;
  limit: string;
  passed: boolean | null;
  warning?: string;
  option?: string;
  remedy?: string;
  frame?: number | null;
}

/** A long edge in an image, and how far its middle is from the line between its ends. */
export interface DriveEdge {
  first: [number, number];
  middle: [number, number];
  last: [number, number];
  bend_px: number;
}

/** The checks of the drive's import, and what to do. */
export interface DriveEvent {
  type: "drive";
  reply_to: string | null;
  drive: DriveView;
}

/** A figure with what it counts. */
export interface DriveFact {
  value: string;
  label: string;
}

/** Matches and edges of the left image of a frame and its right one, or the next one. */
export interface DriveFrameEvent {
  type: "drive_frame";
  reply_to: string | null;
  pair: DrivePair;
}

/** A match between the two images of a picture, and its distance (px) from its line. */
export interface DriveMatch {
  here: [number, number];
  there: [number, number];
  off_px: number;
  depth_m: number | null;
}

/** Two images of a drive, and what was measured in them. */
export interface DrivePair {
  frame: number;
  second: number;
  matches: Array<DriveMatch>;
  edges: [Array<DriveEdge>, Array<DriveEdge>];
  note: string;
}

/** Something to do; ``command`` is for a terminal, ``view`` a view of the page. */
export interface DriveStep {
  title: string;
  text: string;
  command: string;
  view: "" | "images" | "poses";
}

/** All of the view but its picture. */
export interface DriveView {
  title: string;
  sentence: string;
  is_sound: boolean;
  facts: Array<DriveFact>;
  checks: Array<DriveCheck>;
  steps: Array<DriveStep>;
  frames: Array<number>;
  places_m: Array<[number, number]>;
  without_pose: number;
  motion: StepErrors | null;
  file: string;
}

/** What the author of an edit had seen: the operations up to one, and some later requests. Fields that other operations wrote are not the edit's to overwrite. */
export interface EditBase {
  operation: number;
  known?: Array<string>;
  hash?: string;
}

/** An edit is on disk, with the labels and the frame on screen after it. */
export interface EditSavedEvent {
  type: "edit_saved";
  reply_to: string | null;
  labels: LabelsView;
  frame: LabelledFrameView;
  element: string | null;
  added: number;
  note: string;
}

/** An element or an open track was clicked in the 3D scene. */
export interface ElementClickedEvent {
  type: "element_clicked";
  reply_to: string | null;
  element: string;
  is_track: boolean;
}

/** An unsaved drawing. */
export interface ElementDraft {
  side: "left" | "right";
  class_id: number;
  anchor_px: [number, number];
  end_px: [number, number] | null;
  anchor_known?: boolean;
  end_known?: boolean;
  snap?: boolean;
  asks_bottom?: boolean;
  whole?: boolean;
}

/** A note with its element. */
export interface ElementNote {
  id: string;
  frame: number | null;
  unsure: boolean;
  text: string;
  author: string;
  time: string;
  element: string;
  name: string;
}

/** An element labelled in the images on the page, with its observations there. */
export interface ElementView {
  id: string;
  name: string;
  class_id: number;
  observations: Partial<Record<"left" | "right", ObservationView>>;
  views: number;
  review_decisions: Array<ReviewDecisionView>;
  left_out: boolean;
  attributes: Record<string, string>;
  notes: Array<NoteView>;
}

/** Let these frames be labelled as all others again. */
export interface EndShareRequest {
  type: "end_share";
  id: string;
  number: number;
}

/** An element that a decision or finding is about, from labels or map. */
export interface EntryElement {
  id: string | null;
  number: number;
  name: string;
  class_id: number | null;
  map_id: number | null;
  frames: Array<number>;
}

/** A decision of the map, or a finding in it. */
export interface EntryView {
  key: string;
  kind: string;
  by: string | null;
  severity: string | null;
  reason: string;
  evidence: Array<FigureView>;
  elements: Array<EntryElement>;
  about: Array<number>;
  answers: Array<AnswerView>;
  frame: number | null;
}

/** One piece of evidence: ``Distance``, ``0.43 m``. */
export interface FigureView {
  name: string;
  value: string;
}

/** What is proposed for one element in a frame. */
export interface FilmstripCell {
  frame: number;
  proposal: ProposalView;
}

/** What is proposed in a frame, after its images were searched: of known elements, its own images alone. */
export interface FilmstripEvent {
  type: "filmstrip";
  reply_to: string | null;
  frame: number;
  proposals: Array<ProposalView>;
}

/** What is proposed for one element in frames of the strip: nothing in those without a cell. */
export interface FilmstripRowEvent {
  type: "filmstrip_row";
  reply_to: string | null;
  element_id: string;
  frames: Array<number>;
  cells: Array<FilmstripCell>;
}

/** Search some frames for one element anew, by the marks of it that were corrected in the strip; a ``filmstrip_row`` event follows. */
export interface FollowCorrectionsRequest {
  type: "follow_corrections";
  id: string;
  element_id: string;
  frames: Array<number>;
  corrected: Array<DraggedMark>;
}

/** Changed entries of the list of frames. */
export interface FrameListEvent {
  type: "frame_list";
  reply_to: string | null;
  frames: Array<FrameSummary>;
}

/** A frame in the list of frames: its review state and its quality. */
export interface FrameSummary {
  index: number;
  state: "unseen" | "in work" | "reviewed" | "reviewed, empty";
  elements: number;
  worst: WorstLabel | null;
  proposed: number | null;
  disagreement: Disagreement | null;
  asked: Array<string>;
}

/** Show another frame. */
export interface GoToFrameRequest {
  type: "go_to_frame";
  id: string;
  frame: number;
  second?: SecondImage | null;
}

/** An epipolar line as a polyline: in the whole image, and at plausible depths only. */
export interface Guide {
  line: Array<[number, number]>;
  plausible: Array<[number, number]>;
}

/** Size of a camera's images, px. */
export interface ImageSize {
  width: number;
  height: number;
}

/** A class, and the key that chooses it; empty for none. */
export interface KeyedClass {
  id: number;
  name: string;
  kind: "line" | "point";
  letter: string;
  shape: "line" | "triangle" | "square" | "circle" | "diamond" | "pentagon";
  color: string;
  color_light: string;
  key: string;
}

/** What is known about the label file; sent when the page connects and when it changes. */
export interface LabelFileEvent {
  type: "label_file";
  reply_to: string | null;
  state: "checking" | "sound" | "damaged" | "missing";
  text: string;
}

/** The frame on screen. */
export interface LabelledFrameEvent {
  type: "frame";
  reply_to: string | null;
  frame: LabelledFrameView;
}

/** The labels and proposals of one frame, and the elements that may continue in it. */
export interface LabelledFrameView {
  index: number;
  operation: number;
  hash: string;
  panes: Partial<Record<"left" | "right", PaneView>>;
  at_that_time: Record<string, number>;
  elements: Array<ElementView>;
  proposals: Array<ProposalView>;
  nearby: Array<NearbyView>;
  is_searching: boolean;
}

/** The state of the labels and all frames, without the marks of a frame. */
export interface LabelsView {
  operation: number;
  hash: string;
  counts: Record<string, number>;
  mapped: number;
  can_undo: boolean;
  can_redo: boolean;
  history: Array<OperationView>;
  map: MapSummary;
  frames: Array<FrameSummary>;
  team: TeamSummary;
}

/** State that label elements are one landmark: the smallest number keeps all observations. Notes on the others pass to the element that is kept. So do attributes and decisions, unless it has its own. A decision that two of them are apart is revoked. */
export interface Link {
  element_ids: Array<string>;
  kind: "link";
}

/** Request the named states. */
export interface ListNamedStatesRequest {
  type: "list_named_states";
  id: string;
}

/** Request the operations before a number, newest first. */
export interface ListOperationsRequest {
  type: "list_operations";
  id: string;
  before: number;
}

/** The last map, and the number of open decisions and findings. */
export interface MapSummary {
  built: number | null;
  elements: number;
  tracks: number;
  sure_tracks: number;
  decisions: number;
  findings: number;
  building: string | null;
  failure: string;
}

/** Take labels for a frame that two people labelled blind, as the page showed them. */
export interface MergeFrameEdit {
  kind: "merge frame";
  frame_index: number;
  marks: Array<DrawnMark>;
  of_second?: Array<string>;
}

/** The nearest element of the same class that no image shows together with this one. */
export interface MergeOffer {
  id: string;
  name: string;
  class_id: number;
  away_m: number;
}

/** Move the anchor, the end or both; None leaves a point unchanged. */
export interface MoveObservation {
  observation_id: string;
  anchor_px?: [number, number] | null;
  end_px?: [number, number] | null;
  kind: "move";
}

/** An element that refining moves. */
export interface MovedElement {
  id: string;
  name: string;
  class_id: number;
  moved_m: number;
  before_px: number | null;
  after_px: number | null;
}

/** Name the present state. */
export interface NameEdit {
  kind: "name";
  name: string;
}

/** The named states, newest first. */
export interface NamedStatesEvent {
  type: "named_states";
  reply_to: string | null;
  states: Array<OperationView>;
}

/** An element to continue, with the nearest frame in which it is labelled. */
export interface NearbyView {
  id: string;
  name: string;
  class_id: number;
  labelled_in: number;
}

/** Write a note on an element, in the name of who is connected. */
export interface NoteEdit {
  kind: "note";
  note_id: string;
  element_id: string;
  frame_index?: number | null;
  unsure?: boolean;
  text?: string;
}

/** A note on an element. */
export interface NoteView {
  id: string;
  frame: number | null;
  unsure: boolean;
  text: string;
  author: string;
  time: string;
}

/** A label in one image. */
export interface ObservationView {
  id: string;
  anchor: [number, number];
  end: [number, number] | null;
  anchor_known: boolean;
  end_known: boolean;
  frame: number;
  side: "left" | "right";
}

/** Request the address where one labels one's own frames blind. */
export interface OpenShareRequest {
  type: "open_share";
  id: string;
}

/** The detections of an open track; none if it is no longer open. */
export interface OpenTrackEvent {
  type: "open_track";
  reply_to: string | null;
  track_id: string;
  views: Array<TrackImage>;
}

/** One line of the history, and the frame it changed. */
export interface OperationView {
  number: number;
  text: string;
  author: string;
  time: string;
  kind: string;
  frame: number | null;
}

/** Older operations, newest first. */
export interface OperationsEvent {
  type: "operations";
  reply_to: string | null;
  operations: Array<OperationView>;
}

/** An image on the page. */
export interface PaneView {
  frame: number;
  side: "left" | "right";
  camera: string;
}

/** A frame as it was after operation number ``operation``; ``done`` describes it, None for 0. */
export interface PastFrame {
  operation: number;
  done: OperationView | null;
  frame: LabelledFrameView;
}

/** A frame of an earlier state. */
export interface PastFrameEvent {
  type: "past_frame";
  reply_to: string | null;
  past: PastFrame;
}

/** Who may label this workspace, and where they are; sent when it changes. */
export interface PeopleEvent {
  type: "people";
  reply_to: string | null;
  people: Array<PersonView>;
}

/** Somebody who was invited, or who started the server and has a page open. */
export interface PersonView {
  name: string;
  role: "annotate" | "review" | "look";
  frames: Array<number>;
  element: string;
}

/** What a person may choose, and what it costs. */
export interface PoseAnswer {
  choice: "refine" | "leave out" | "keep" | "ask";
  title: string;
  price: string;
  preview: string;
  refusal: string;
}

/** A figure before and after refining. */
export interface PoseEffect {
  name: string;
  before: string;
  after: string;
}

/** A line of facts about a stretch. */
export interface PoseFact {
  name: string;
  value: string;
}

/** The elements of a frame under the given and the refined pose. */
export interface PoseFrameEvent {
  type: "pose_frame";
  reply_to: string | null;
  frame: number;
  stretch: number;
  marks: Array<PoseMark>;
}

/** An element in the left image: the label, and the map under the given and the refined pose. */
export interface PoseMark {
  id: string;
  name: string;
  class_id: number;
  label: [[number, number], [number, number] | null];
  before: [[number, number], [number, number] | null] | null;
  after: [[number, number], [number, number] | null] | null;
  before_px: number | null;
  after_px: number | null;
}

/** A choice for poses is on disk; the workspace is sent again with the chosen poses. */
export interface PosesChosenEvent {
  type: "poses_chosen";
  reply_to: string | null;
  text: string;
}

/** How the poses compare with the images, as far as that is known. */
export interface PosesEvent {
  type: "poses";
  reply_to: string | null;
  state: "unknown" | "working" | "ready" | "failed";
  done: number;
  total: number;
  seconds: number;
  failure: string;
  poses: PosesView | null;
}

/** All frames of a drive, and its faults. */
export interface PosesView {
  frames: Array<number>;
  shift_px: Array<number | null>;
  turn_deg: Array<number | null>;
  refined_deg: Array<number | null>;
  turn_words: [string, string];
  alone_px: Array<number | null>;
  stretches: Array<StretchView>;
  open: number;
  sentence: string;
  unchecked: string;
}

/** Request guides and numbers of a draft. */
export interface PreviewDraftRequest {
  type: "preview_draft";
  id: string;
  draft: DraftState;
}

/** Find where the accepted labels of an element snap to; ``resnap`` follows. */
export interface PreviewReSnapRequest {
  type: "preview_resnap";
  id: string;
  element_id: string;
}

/** The proposed mark of an element in one image. */
export interface ProposalMark {
  anchor: [number, number];
  end: [number, number] | null;
  anchor_known: boolean;
  end_known: boolean;
  id: string;
  frame: number;
  side: "left" | "right";
  score: number | null;
  runner_up: RunnerUp | null;
}

/** The proposal of one element, with its marks in the images on the page. Doubtful ones come first, then the nearest. */
export interface ProposalView {
  id: string;
  name: string;
  class_id: number;
  origin: "map" | "match" | "detector";
  depth_m: number | null;
  rejected_elsewhere: boolean;
  is_confident: boolean;
  score: number | null;
  track: TrackView | null;
  marks: Partial<Record<"left" | "right", ProposalMark>>;
}

/** A frame that is reviewed, was sent back, or has comments while it is in work. */
export interface QueueEntry {
  frame: number;
  state: "waiting" | "sent back" | "accepted" | "in work";
  person: string;
  elements: number;
  stands_out: string;
  notes: Array<ElementNote>;
  time: string;
}

/** Move observations to the edges that the images show, all or none. */
export interface ReSnap {
  moves: Array<MoveObservation>;
  kind: "re-snap";
}

/** What a re-snap of an element would do. */
export interface ReSnapEvent {
  type: "resnap";
  reply_to: string | null;
  element: string;
  preview: ReSnapPreview;
}

/** What a re-snap would do. */
export interface ReSnapPreview {
  moves: Array<SnapMove>;
  by_px: number;
  unclear: number;
  drawn: number;
}

/** Redo what the author undid last. */
export interface RedoEdit {
  kind: "redo";
}

/** Reject tracks of detections in all their images: no map will have them. */
export interface RejectTracksEdit {
  kind: "reject tracks";
  track_ids: Array<string>;
}

/** Restore the state after an operation. */
export interface RestoreEdit {
  kind: "restore";
  number: number;
}

/** A person's decision about one or two label elements; every map build follows it. */
export interface ReviewDecision {
  id: string;
  verdict: "apart" | "keep" | "leave out";
  element_id: string;
  other_id: string | null;
}

/** A person's decision about an element, applied in every map build. */
export interface ReviewDecisionView {
  id: string;
  text: string;
}

/** One entry of a list; ``entry`` is None if the list is empty. */
export interface ReviewEntry {
  list_name: "tracks" | "decisions" | "findings";
  count: number;
  place: number;
  entry: EntryView | null;
}

/** The open decision or finding; None for none. */
export interface ReviewEvent {
  type: "review";
  reply_to: string | null;
  review: ReviewEntry | null;
}

/** Set a frame's review state; ``unseen`` removes the review. */
export interface ReviewFrame {
  frame_index: number;
  state: "unseen" | "in work" | "reviewed" | "reviewed, empty";
  kind: "review";
}

/** Remove a review decision, so that map building decides again. */
export interface RevokeDecision {
  judgement_id: string;
  kind: "take back";
}

/** The second best mark. */
export interface RunnerUp {
  anchor: [number, number];
  end: [number, number] | null;
  anchor_known: boolean;
  end_known: boolean;
  score: number;
}

/** A drawing lies on a label: it may be that one's correction, or another element. */
export interface SamePlaceEvent {
  type: "error";
  reply_to: string | null;
  code: "conflict";
  text: string;
  retry: boolean;
  element_id: string;
  name: string;
  observation_id: string;
  anchor: [number, number] | null;
  end: [number, number] | null;
}

/** An edit is on disk; ``edit_saved`` follows. */
export interface SavedOperationEvent {
  type: "saved_operation";
  reply_to: string | null;
  operation: number;
}

/** The 3D scene can be opened. */
export interface SceneEvent {
  type: "scene";
  reply_to: string | null;
}

/** Search the images of some frames for all known elements; a ``filmstrip`` event follows for each. A later request replaces it. */
export interface SearchFilmstripRequest {
  type: "search_filmstrip";
  id: string;
  frames: Array<number>;
}

/** Search the images of a range of frames for an element; ``track_proposals`` follows. A later one replaces it. */
export interface SearchTrackRequest {
  type: "search_track";
  id: string;
  element_id: string;
  first: number;
  last: number;
}

/** The wish for another second image than the usual one. */
export interface SecondImage {
  camera?: string | null;
  step?: number | null;
}

/** Send a reviewed frame back to who labelled it: it is in work again. */
export interface SendBackFrame {
  frame_index: number;
  kind: "send back";
}

/** Set an attribute of an element; None removes it. */
export interface SetAttribute {
  element_id: string;
  name: string;
  value: string | null;
  kind: "set attribute";
}

/** Show or hide the backdrop in 3D; one that was made meanwhile is found. */
export interface SetBackdropRequest {
  type: "set_backdrop";
  id: string;
  shown: boolean;
}

/** Change the class of an element, within its kind: a sign stays a sign. */
export interface SetClass {
  element_id: string;
  class_id: number;
  kind: "set class";
}

/** Change the class of several elements, all or none, each like ``SetClass``. */
export interface SetClassOfMany {
  element_ids: Array<string>;
  class_id: number;
  kind: "set class of many";
}

/** Change the class of some observations of an element, within its kind. If they are not all of its observations, they become a new element, kept apart from it. */
export interface SetClassOfViews {
  observation_ids: Array<string>;
  class_id: number;
  new_element_id: string;
  kind: "set class of views";
}

/** Set whether the ends of a pole are visible, not cut off or hidden; None: unchanged. */
export interface SetKnown {
  observation_id: string;
  anchor_known?: boolean | null;
  end_known?: boolean | null;
  kind: "set known";
}

/** Set whether the ends of several poles are visible, all or none, each like ``SetKnown``. */
export interface SetKnownOfMany {
  observation_ids: Array<string>;
  anchor_known?: boolean | null;
  end_known?: boolean | null;
  kind: "set known of many";
}

/** Use dark or light colours. */
export interface SetThemeRequest {
  type: "set_theme";
  id: string;
  theme: "dark" | "light";
}

/** Where one labels one's own frames blind. */
export interface ShareOpenedEvent {
  type: "share_opened";
  reply_to: string | null;
  address: string;
}

/** Frames that two people label blind. */
export interface ShareView {
  number: number;
  people: [string, string];
  frames: Array<number>;
  reviewed: [number, number];
  ready: Array<number>;
  worst_px: Array<number>;
  merged: number;
  agreement: AgreementView | null;
}

/** Request two versions of a frame: of two people who labelled it blind, or earlier and now. */
export interface ShowComparedRequest {
  type: "show_compared";
  id: string;
  frame: number;
}

/** Request matches and edges of the images of a frame; a ``drive_frame`` event follows. */
export interface ShowDriveFrameRequest {
  type: "show_drive_frame";
  id: string;
  frame: number;
}

/** Request the checks of the drive's import, and what to do. */
export interface ShowDriveRequest {
  type: "show_drive";
  id: string;
}

/** Request the detections of an open track. */
export interface ShowOpenTrackRequest {
  type: "show_open_track";
  id: string;
  track_id: string;
}

/** Request a frame as it was after an operation. */
export interface ShowPastFrameRequest {
  type: "show_past_frame";
  id: string;
  operation: number;
  frame: number;
  second?: number | null;
}

/** Request the elements of a frame under the given and the refined pose. */
export interface ShowPoseFrameRequest {
  type: "show_pose_frame";
  id: string;
  frame: number;
  stretch: number;
}

/** Compare the poses with the images, unless that is done; ``poses`` events follow. */
export interface ShowPosesRequest {
  type: "show_poses";
  id: string;
}

/** Open the entry of a list ``by`` places after the one with ``key``. */
export interface ShowReviewRequest {
  type: "show_review";
  id: string;
  list_name: "tracks" | "decisions" | "findings";
  key?: string | null;
  place?: number;
  by?: -1 | 0 | 1;
}

/** Request who has what, and the queue. */
export interface ShowTeamRequest {
  type: "show_team";
  id: string;
}

/** Request one element: its labels, what is wrong, what could be done. */
export interface ShowTrackRequest {
  type: "show_track";
  id: string;
  element_id: string;
}

/** Request the rows of all elements; those that are not known yet follow. */
export interface ShowTracksRequest {
  type: "show_tracks";
  id: string;
}

/** Where a label snaps to. */
export interface SnapMove {
  observation_id: string;
  anchor_px: [number, number];
  end_px: [number, number] | null;
}

/** A drawing snapped to edges; its ends move by ``by_px`` at most. */
export interface SnappedMark {
  anchor: [number, number];
  end: [number, number] | null;
  anchor_known: boolean;
  end_known: boolean;
  by_px: number;
}

/** How far the steps of n poses are from those of the images. */
export interface StepErrors {
  frames: Array<number>;
  turn_deg: Array<number>;
  shift_m: Array<number>;
  wrong: Array<boolean>;
  usual: [number, number];
}

/** Cancel the map build. */
export interface StopMapBuildRequest {
  type: "stop_map_build";
  id: string;
}

/** A fault of poses: what is wrong, what can be done, and what that changes. */
export interface StretchView {
  first: number;
  last: number;
  subject: "frames" | "axes" | "time" | "heights" | "baseline" | "right image";
  where: string;
  title: string;
  sentence: string;
  sigmas: number | null;
  facts: Array<PoseFact>;
  answers: Array<PoseAnswer>;
  effects: Array<PoseEffect>;
  moved: Array<MovedElement>;
  chosen: "refine" | "leave out" | "keep" | "ask" | null;
  chosen_by: string;
}

/** Swap the peak and the bottom of a pole. */
export interface SwapEnds {
  observation_id: string;
  kind: "swap ends";
}

/** The work of all. */
export interface TeamEvent {
  type: "team";
  reply_to: string | null;
  team: TeamView;
  shares: Array<ShareView>;
}

/** One person's share of the work. */
export interface TeamPerson {
  name: string;
  ranges: Array<[number, number]>;
  assigned: number;
  reviewed: number;
  pace: number;
  edits: number;
  last: string;
  done_on: string;
}

/** What the page of everybody knows of the work of all. */
export interface TeamSummary {
  sent_back: Array<number>;
  assigned: Record<string, Array<[number, number]>>;
}

/** The work of all. */
export interface TeamView {
  people: Array<TeamPerson>;
  queue: Array<QueueEntry>;
  reviewed: number;
  done_on: string;
}

/** One element, as of an operation. */
export interface TrackDetails {
  id: string;
  operation: number;
  hash: string;
  labels: Array<TrackLabel>;
  split: TrackSplit | null;
  merge: MergeOffer | null;
  place: string;
  drawn_by: string;
}

/** One element. */
export interface TrackEvent {
  type: "track";
  reply_to: string | null;
  track: TrackDetails;
}

/** Elements that are expected in the images of a frame and not labelled there, by number. */
export interface TrackFrame {
  index: number;
  left: Array<number>;
  right: Array<number>;
}

/** A label or a detection of an element, with what the strip of views shows of it. */
export interface TrackImage {
  id: string;
  frame: number;
  side: "left" | "right";
  anchor: [number, number];
  end: [number, number] | null;
  px: number | null;
  size_px: number;
}

/** A label of the element, with what the card shows of it, too. */
export interface TrackLabel {
  id: string;
  frame: number;
  side: "left" | "right";
  anchor: [number, number];
  end: [number, number] | null;
  px: number | null;
  size_px: number;
  accepted: boolean;
}

/** A proposed label of the element, confirmed by its image or not. */
export interface TrackProposal {
  id: string;
  frame: number;
  side: "left" | "right";
  anchor: [number, number];
  end: [number, number] | null;
  anchor_known: boolean;
  end_known: boolean;
  score: number;
  is_confident: boolean;
}

/** What the images of a range of frames show of an element that is not labelled there. */
export interface TrackProposalsEvent {
  type: "track_proposals";
  reply_to: string | null;
  element: string;
  first: number;
  last: number;
  proposals: Array<TrackProposal>;
}

/** An element in all frames from the first that shows something of it to the last. */
export interface TrackRow {
  id: string;
  name: string;
  class_id: number;
  number: number;
  first: number;
  left: Array<number>;
  right: Array<number>;
  views: number;
  worst_px: number | null;
  score: number | null;
  doubt: string;
  left_out: boolean;
  notes: Array<NoteView>;
  attributes: Record<string, string>;
}

/** The labels fit two elements better than one. */
export interface TrackSplit {
  frame: number;
  title: string;
  text: string;
}

/** A track of detections, which is accepted or rejected as a whole. */
export interface TrackView {
  frames: number;
  first: number;
  last: number;
  residual_px: number;
  existence: string;
  doubt: string;
}

/** Rows of elements and open tracks, and what is expected in frames; added to those before. */
export interface TracksEvent {
  type: "tracks";
  reply_to: string | null;
  rows: Array<TrackRow>;
  frames: Array<TrackFrame>;
  total: number | null;
  waiting: number;
}

/** Undo the author's last edit, or that of a request. */
export interface UndoEdit {
  kind: "undo";
  request?: string | null;
}

/** State that observations of an element show another landmark: a new element, kept apart. Notes on frames that only the new element is labelled in go along. */
export interface Unlink {
  observation_ids: Array<string>;
  new_element_id: string;
  kind: "unlink";
}

/** The labels have changed, on another page or in another process. */
export interface UpdateEvent {
  type: "update";
  reply_to: string | null;
  labels: LabelsView;
  frame: LabelledFrameView | null;
}

/** The workspace and its labels; sent when the page connects. */
export interface WorkspaceEvent {
  type: "workspace";
  reply_to: string | null;
  workspace: WorkspaceView;
  labels: LabelsView;
}

/** What does not change while the page is open. */
export interface WorkspaceView {
  name: string;
  key: string;
  source: string;
  author: string;
  role: "annotate" | "review" | "look";
  classes: Array<KeyedClass>;
  attribute_types: Array<AttributeType>;
  triangle_center: "box" | "centroid";
  images: Partial<Record<"left" | "right", ImageSize>>;
  has_right: boolean;
  cameras: Array<string>;
  is_blind: boolean;
}

/** The label furthest from the projection of its element. */
export interface WorstLabel {
  px: number;
  element: string | null;
}

export interface Requests {
  apply_edit: ApplyEditRequest;
  assign_frames: AssignFramesRequest;
  assign_share: AssignShareRequest;
  build_map: BuildMapRequest;
  choose_poses: ChoosePosesRequest;
  close_review: CloseReviewRequest;
  end_share: EndShareRequest;
  follow_corrections: FollowCorrectionsRequest;
  go_to_frame: GoToFrameRequest;
  list_named_states: ListNamedStatesRequest;
  list_operations: ListOperationsRequest;
  open_share: OpenShareRequest;
  preview_draft: PreviewDraftRequest;
  preview_resnap: PreviewReSnapRequest;
  search_filmstrip: SearchFilmstripRequest;
  search_track: SearchTrackRequest;
  set_backdrop: SetBackdropRequest;
  set_theme: SetThemeRequest;
  show_compared: ShowComparedRequest;
  show_drive: ShowDriveRequest;
  show_drive_frame: ShowDriveFrameRequest;
  show_open_track: ShowOpenTrackRequest;
  show_past_frame: ShowPastFrameRequest;
  show_pose_frame: ShowPoseFrameRequest;
  show_poses: ShowPosesRequest;
  show_review: ShowReviewRequest;
  show_team: ShowTeamRequest;
  show_track: ShowTrackRequest;
  show_tracks: ShowTracksRequest;
  stop_map_build: StopMapBuildRequest;
}

export interface Events {
  backdrop: BackdropEvent;
  compared: ComparedEvent;
  draft_preview: DraftPreviewEvent;
  drive: DriveEvent;
  drive_frame: DriveFrameEvent;
  edit_saved: EditSavedEvent;
  element_clicked: ElementClickedEvent;
  error: ConflictEvent | ErrorEvent | SamePlaceEvent;
  filmstrip: FilmstripEvent;
  filmstrip_row: FilmstripRowEvent;
  frame: LabelledFrameEvent;
  frame_list: FrameListEvent;
  hello: HelloEvent;
  label_file: LabelFileEvent;
  named_states: NamedStatesEvent;
  open_track: OpenTrackEvent;
  operations: OperationsEvent;
  past_frame: PastFrameEvent;
  people: PeopleEvent;
  pose_frame: PoseFrameEvent;
  poses: PosesEvent;
  poses_chosen: PosesChosenEvent;
  resnap: ReSnapEvent;
  review: ReviewEvent;
  saved_operation: SavedOperationEvent;
  scene: SceneEvent;
  share_opened: ShareOpenedEvent;
  team: TeamEvent;
  track: TrackEvent;
  track_proposals: TrackProposalsEvent;
  tracks: TracksEvent;
  update: UpdateEvent;
  workspace: WorkspaceEvent;
}

}

export namespace inspector {
/** Store a review decision in the labels. */
export interface AnswerDecisionRequest {
  type: "answer_decision";
  id: string;
  key: string;
  name: string;
  base?: EditBase | null;
}

/** A possible answer to a decision. */
export interface AnswerOption {
  name: string;
  title: string;
}

/** Whether there is a backdrop to show; if not, ``note`` says why and what to do. */
export interface BackdropEvent {
  type: "backdrop";
  reply_to: string | null;
  available: boolean;
  note: string;
}

/** The frame numbered ``index`` in A; null where A does not have it. */
export interface BaseFrameEvent {
  type: "base_frame";
  reply_to: string | null;
  index: number;
  base: BaseFrameView | null;
}

/** A frame as A has it, and the submap in its right image. */
export interface BaseFrameView {
  frame: FrameView;
  right: Array<RightMapped> | null;
}

/** What somebody decided on a change, by its name. */
export interface ChangeAnswer {
  name: string;
  answer: "make" | "keep" | "label" | "open";
  author: string;
  time: string;
  label: string;
}

/** What is decided. ``note`` says where it is kept, or why nothing can be decided. */
export interface ChangeAnswersEvent {
  type: "change_answers";
  reply_to: string | null;
  answers: Array<ChangeAnswer>;
  seen: number;
  can_undo: boolean;
  can_decide: boolean;
  note: string;
  next_map: string;
}

/** A frame that a sweep fixed or broke. */
export interface ChangedFrame {
  index: number;
  change: "fixed" | "broken";
}

/** The changed map was written. */
export interface ChangedMapEvent {
  type: "changed_map";
  reply_to: string | null;
  name: string;
  text: string;
  diff: string;
}

/** Check conditions of ``semviz compare --fail-if``. */
export interface CheckGatesRequest {
  type: "check_gates";
  id: string;
  conditions: Array<string>;
}

/** The field ``name`` of a change, as a list to choose from. */
export interface ChoiceField {
  name: string;
  options: Array<OptionValue>;
}

/** Compare with the run ``base``, side by side or not. Empty: no comparison. */
export interface CompareRunsRequest {
  type: "compare_runs";
  id: string;
  base: string;
  side_by_side: boolean;
}

/** The result of one run for a frame. */
export interface ComparedAnswer {
  status: "ok" | "ambiguous" | "cannot";
  error_m: number | null;
  error_deg: number | null;
  overconfident: boolean;
}

/** A frame of both runs; ``position`` is that in B. */
export interface ComparedFrame {
  index: number;
  position: number;
  change: "fixed" | "broken" | "same";
  a: ComparedAnswer;
  b: ComparedAnswer;
}

/** The two runs were compared. */
export interface ComparisonEvent {
  type: "comparison";
  reply_to: string | null;
  comparison: ComparisonView;
}

/** Everything about two runs that does not depend on the frame shown. */
export interface ComparisonView {
  other: string;
  base: RunHead;
  frames: Array<ComparedFrame>;
  only_base: Array<number>;
  only_other: Array<number>;
  metrics: Array<MetricRow>;
  names: Array<string>;
  setups: Array<SetupRow>;
  notes: Array<string>;
  same_map: boolean;
  unchanged: number;
  changes: Array<MapChangeView>;
  more_changes: number;
  base_ids: Record<string, number>;
  command: string;
}

/** Decide on changes of the map, by their names. */
export interface DecideChangesRequest {
  type: "decide_changes";
  id: string;
  names: Array<string>;
  answer: "make" | "keep" | "label" | "open";
  seen: number;
}

/** An element of a decision; ``map_id`` is null if it is not in the map. */
export interface DecidedElement {
  name: string;
  class_id: number | null;
  map_id: number | null;
}

/** A decision of map building (``by``) or a finding of lint (``severity``). */
export interface DecisionView {
  key: string;
  kind: string;
  by: string | null;
  severity: string | null;
  reason: string;
  evidence: Array<EvidenceLine>;
  elements: Array<DecidedElement>;
  answers: Array<AnswerOption>;
  undo: boolean;
}

/** Decisions and findings of the map, and where answers are saved. */
export interface DecisionsEvent {
  type: "decisions";
  reply_to: string | null;
  entries: Array<DecisionView>;
  note: string;
  seen: EditBase;
}

/** The diagnosis of a frame as people read it. */
export interface DiagnosisCard {
  title: string;
  sentence: string;
  confidence: number | null;
  tells_apart: string;
  implicated: Array<string>;
  rows: Array<[string, string]>;
  alternatives: Array<OtherPose>;
  more_alternatives: number;
  times_ms: Array<[string, number]>;
  poses_tried: number | null;
}

/** Draw the frame in 3D. The page sends no request for frames that it skips. */
export interface DrawFrameRequest {
  type: "draw_frame";
  id: string;
}

/** Drop the change. */
export interface DropWhatIfRequest {
  type: "drop_what_if";
  id: string;
}

/** What the author of an edit had seen: the operations up to one, and some later requests. Fields that other operations wrote are not the edit's to overwrite. */
export interface EditBase {
  operation: number;
  known?: Array<string>;
  hash?: string;
}

/** A map element, from the camera of one frame. */
export interface ElementCard {
  name: string;
  class_id: number;
  place: Array<EndView>;
  meaning: string;
  existence: string;
  in_run: Array<[string, string]>;
  decisions: Array<MapDecision>;
}

/** A class of elements, with its colours in both themes. */
export interface ElementClassView {
  id: number;
  name: string;
  letter: string;
  shape: "line" | "triangle" | "square" | "circle" | "diamond" | "pentagon";
  color: string;
  color_light: string;
}

/** Positions of the frames that detect an element, or whose estimate uses it. */
export interface ElementFramesEvent {
  type: "element_frames";
  reply_to: string | null;
  element: number;
  name: string;
  positions: Array<number>;
}

/** A map element over the run: numbers of frames, and its effect on the error. */
export interface ElementRow {
  id: number;
  name: string;
  class_id: number;
  in_view: number;
  seen: number;
  used: number;
  outlier: number;
  share: number | null;
  median_px: number | null;
  cost_m: number | null;
  blamed: Array<[string, number]>;
  duplicate: string;
  duplicate_m: number | null;
  log_odds: number | null;
  existence: string;
  position: number | null;
}

/** The diagnosis of the run, or its progress. */
export interface ElementsEvent {
  type: "elements";
  reply_to: string | null;
  progress: string;
  found: RunFindings | null;
}

/** An end of an element: distance from the camera, and 1 sigma across, along, up (m). */
export interface EndView {
  end: string;
  known: boolean;
  distance_m: number;
  sigma_m: [number, number, number];
}

/** A value of the evidence, as text. */
export interface EvidenceLine {
  name: string;
  value: string;
}

/** Edit the labels of an element so that maps leave it out. */
export interface ExcludeElementRequest {
  type: "exclude_element";
  id: string;
  element: number;
  base?: EditBase | null;
}

/** Find the frames that detect an element, or whose estimate uses it. */
export interface FindFramesRequest {
  type: "find_frames";
  id: string;
  element: number;
}

/** The expected error along the route, or the progress of its computation. */
export interface ForecastEvent {
  type: "forecast";
  reply_to: string | null;
  progress: string;
  found: ForecastView | null;
}

/** Expected error of each frame (m), limits of its levels, and landmarks to add. */
export interface ForecastView {
  limits: Array<number>;
  expected_m: Array<number | null>;
  mean_m: number;
  suggested: Array<SuggestedElement>;
}

/** Drop a kept change, by its index. */
export interface ForgetWhatIfRequest {
  type: "forget_what_if";
  id: string;
  number: number;
}

/** Columns over all frames. Errors are null without a pose or ground truth. */
export interface FrameColumns {
  index: Array<number>;
  status: Array<number>;
  statuses: Array<string>;
  texts: Array<string>;
  reason: Array<number>;
  diagnosis: Array<number>;
  noticed: Array<number>;
  overconfident: Array<number>;
  error_m: Array<number | null>;
  error_deg: Array<number | null>;
  ms: Array<number>;
}

/** Another frame is shown. */
export interface FrameEvent {
  type: "frame";
  reply_to: string | null;
  frame: FrameView;
  state: StateView;
}

/** A frame with all that the page draws of it. */
export interface FrameView {
  index: number;
  status: "ok" | "ambiguous" | "cannot";
  reason: string;
  diagnosis: string;
  overconfident: boolean;
  noticed: string;
  error_m: number | null;
  error_deg: number | null;
  ms: number;
  position: number;
  has_truth: boolean;
  observed: Array<ObservedView>;
  mapped: Array<MappedView>;
  pairs: Array<PairView>;
  true_pairs: Array<PairView>;
  matrix: MatrixView | null;
  missed_detections: Array<number>;
  false_positives: Array<number>;
  card: DiagnosisCard;
}

/** A condition, its values as text, and whether it fails; null if that is unknown. */
export interface GateView {
  text: string;
  fails: boolean | null;
  values: string;
}

/** The conditions that the page sent. */
export interface GatesEvent {
  type: "gates";
  reply_to: string | null;
  gates: Array<GateView>;
}

/** List the decisions of map building and, on request, the findings of lint (slower). */
export interface GetDecisionsRequest {
  type: "get_decisions";
  id: string;
  findings?: boolean;
}

/** Diagnose the whole run, with statistics of each map element. */
export interface GetElementsRequest {
  type: "get_elements";
  id: string;
}

/** Count the label edits that are newer than the map of this run. */
export interface GetLabelEditsRequest {
  type: "get_label_edits";
  id: string;
}

/** Read the labels behind the selected element. */
export interface GetOriginsRequest {
  type: "get_origins";
  id: string;
}

/** Search the runs for changes of the open run's map. */
export interface GetOverTimeRequest {
  type: "get_over_time";
  id: string;
}

/** Request the solver's stages for this frame. */
export interface GetSolverRequest {
  type: "get_solver";
  id: string;
}

/** Tell the story of the open run. */
export interface GetStoryRequest {
  type: "get_story";
  id: string;
}

/** Request the user's viewpoint in 3D. */
export interface GetViewpointRequest {
  type: "get_viewpoint";
  id: string;
}

/** List the changes that fit the selection and the frame. */
export interface GetWhatIfOptionsRequest {
  type: "get_what_if_options";
  id: string;
}

/** Show the frame that shows a change best, before it or after, and select its element. */
export interface GoToChangeRequest {
  type: "go_to_change";
  id: string;
  name: string;
  is_after: boolean;
}

/** Select the element of a decision in a frame that shows it. */
export interface GoToDecisionRequest {
  type: "go_to_decision";
  id: string;
  key: string;
}

/** Show the frame at a position of the run. */
export interface GoToPositionRequest {
  type: "go_to_position";
  id: string;
  position: number;
}

/** Look from ``eye`` to ``target``, metres in the map frame. */
export interface GoToViewpointRequest {
  type: "go_to_viewpoint";
  id: string;
  eye: [number, number, number];
  target: [number, number, number];
}

/** Size of a camera's images, px. */
export interface ImageSize {
  width: number;
  height: number;
}

/** Save the new map as the map of the workspace. */
export interface KeepMapRequest {
  type: "keep_map";
  id: string;
}

/** Keep the change for all frames. */
export interface KeepWhatIfRequest {
  type: "keep_what_if";
  id: string;
}

/** Label edits newer than the map; ``workspace`` is empty if the labels are not found. */
export interface LabelEditsEvent {
  type: "label_edits";
  reply_to: string | null;
  workspace: string;
  edits: number;
  undoable: number;
  seen: EditBase | null;
  rebuild: RebuildView | null;
}

/** The address of the page that shows a label, relative to this page. */
export interface LabelPageEvent {
  type: "label_page";
  reply_to: string | null;
  address: string;
}

/** A run that is no pass, and why. */
export interface LeftOutRun {
  run: string;
  reason: string;
}

/** A difference between the maps, with the broken and fixed frames that have it in view. */
export interface MapChangeView {
  kind: "added" | "removed" | "merged" | "split" | "class changed" | "moved";
  names: Array<string>;
  was: Array<string>;
  moved_m: number | null;
  element: number | null;
  base_element: number | null;
  broken: Array<number>;
  fixed: Array<number>;
}

/** A colour of the map: its line, its name, and how many elements have it. */
export interface MapColorLevel {
  color: string;
  width: number;
  name: string;
  elements: number;
}

/** The legend of the map in 3D; ``magnified`` is the scale of ellipsoids, if they are shown. */
export interface MapColorsEvent {
  type: "map_colors";
  reply_to: string | null;
  legend: MapLegend;
  magnified: number | null;
}

/** A decision of map building about the label elements behind a map element. */
export interface MapDecision {
  kind: string;
  by: string;
  reason: string;
  names: Array<string>;
}

/** The meaning of the map's colours; without levels they show the classes. */
export interface MapLegend {
  by: "class" | "residual" | "times";
  levels: Array<MapColorLevel>;
}

/** The new map was saved as the map of the workspace. */
export interface MapSavedEvent {
  type: "map_saved";
  reply_to: string | null;
  text: string;
}

/** An element of the submap in the image under the new pose. */
export interface MappedElement {
  class_id: number;
  place: [[number, number], [number, number] | null];
}

/** An element of the submap, projected with the estimated and the true pose. */
export interface MappedView {
  id: number;
  name: string;
  class_id: number;
  estimate: [[number, number], [number, number] | null] | null;
  truth: [[number, number], [number, number] | null] | null;
  behind: boolean;
}

/** A cell of the probability matrix; a null row or column is the dustbin. */
export interface MatrixCell {
  name: string;
  observed: number | null;
  element: number | null;
  probability: number;
  rank: number;
  is_true: boolean;
}

/** Match probabilities (m + 1, n + 1), and the order of rows and columns by class. */
export interface MatrixView {
  probability: Array<Array<number>>;
  rows: Array<number>;
  columns: Array<number>;
}

/** Link the labels that the diagnosis of this frame calls duplicates. */
export interface MergeDuplicatesRequest {
  type: "merge_duplicates";
  id: string;
  base?: EditBase | null;
}

/** A metric of both runs, as text. */
export interface MetricRow {
  name: string;
  label: string;
  a: string;
  b: string;
  trend: "better" | "worse" | "same";
}

/** A neighbouring frame, with the selected element as detected and as mapped. */
export interface NeighbourView {
  position: number;
  seen: PlacedElement | null;
  mapped: PlacedElement | null;
}

/** The neighbouring frames. */
export interface NeighboursEvent {
  type: "neighbours";
  reply_to: string | null;
  frames: Array<NeighbourView>;
}

/** The field ``name`` of a change, as a number to enter. */
export interface NumberField {
  name: string;
  label: string;
  value: number;
  unit: string;
}

/** A detection; ``truth`` is the row of its true element in ``mapped``. */
export interface ObservedView {
  class_id: number;
  anchor: [number, number];
  end: [number, number] | null;
  anchor_known: boolean;
  end_known: boolean;
  truth: number | null;
}

/** Open the frame in which a label of a change is asked for. */
export interface OpenAskedLabelRequest {
  type: "open_asked_label";
  id: string;
  name: string;
}

/** Open the label of an element. Default: the element that the diagnosis names. */
export interface OpenLabelRequest {
  type: "open_label";
  id: string;
  element?: number | null;
}

/** Show a run at the frame with this number. Default: the first run, its worst frame. */
export interface OpenRunRequest {
  type: "open_run";
  id: string;
  run?: string | null;
  frame?: number | null;
  theme?: "dark" | "light";
}

/** A value to choose for a field of a change. */
export interface OptionValue {
  value: number | string;
  text: string;
}

/** A label element behind a map element. */
export interface OriginView {
  name: string;
  class_id: number;
  left: number;
  right: number;
  frames: Array<[number, string]>;
  others: number;
  writer: WriterView | null;
  is_newer: boolean;
}

/** The labels behind an element, or the reason why there are none. */
export interface OriginsEvent {
  type: "origins";
  reply_to: string | null;
  element: number;
  reason: string;
  entries: Array<OriginView>;
}

/** An alternative pose: its distance from the estimate, and its log-likelihood below it. */
export interface OtherPose {
  name: string;
  distance_m: number;
  angle_deg: number;
  gap_nats: number | null;
}

/** A change of the map. Places are metres in the map frame. */
export interface OverTimeChange {
  name: string;
  class_id: number;
  seen: Array<number>;
  chances: Array<number>;
  probability: Array<number>;
  kind: "vanished" | "new" | "moved" | "unsure";
  element: number | null;
  since: number | null;
  existence: number;
  place: [number, number];
  was: [number, number] | null;
  title: string;
  story: string;
  sentence: string;
  facts: Array<EvidenceLine>;
  near: Array<PassRow>;
  before: PassShot | null;
  after: PassShot | null;
}

/** The map over time; without ``found``, ``progress`` says how far the search is, or why there is no answer. */
export interface OverTimeEvent {
  type: "over_time";
  reply_to: string | null;
  progress: string;
  is_over: boolean;
  left_out: Array<LeftOutRun>;
  found: OverTimeView | null;
}

/** What the passes say about the map. */
export interface OverTimeView {
  map: string;
  elements: number;
  passes: Array<PassView>;
  changes: Array<OverTimeChange>;
  standing: Array<StandingElement>;
  route: Array<[number, number]>;
}

/** Rows of a detection and an element, and the residual vector from ``start`` (px). */
export interface PairView {
  observed: number;
  mapped: number;
  inlier: boolean;
  residual_px: number | null;
  start: [number | null, number | null];
  vector: [number | null, number | null];
}

/** What each pass saw of an element: frames that detect it, of those with it in view. */
export interface PassRow {
  name: string;
  class_id: number;
  seen: Array<number>;
  chances: Array<number>;
  probability: Array<number>;
}

/** A frame that shows an element, or the place where it should be. */
export interface PassShot {
  run: string;
  position: number;
  frame: number;
  date: string;
  ends: Array<[number, number]>;
  is_seen: boolean;
}

/** A run that counts as a pass; ``date`` is empty if it is not known. */
export interface PassView {
  run: string;
  date: string;
  frames: number;
  sure: number;
}

/** An element in an image. */
export interface PlacedElement {
  class_id: number;
  place: [[number, number], [number, number] | null];
}

/** The difference between two poses. */
export interface PoseDifference {
  m: number;
  deg: number;
}

/** A run is read through before it opens: what is done, and the share of it that is done. */
export interface ReadingEvent {
  type: "reading";
  reply_to: string | null;
  name: string;
  step: string;
  share: number;
}

/** Build the map from the labels again and localize the run in it. */
export interface RebuildMapRequest {
  type: "rebuild_map";
  id: string;
}

/** The map being built again; ``run`` names the new run. */
export interface RebuildView {
  is_over: boolean;
  progress: string;
  run: string | null;
}

/** Render the 3D pane as an image of this size (px). */
export interface RenderSceneRequest {
  type: "render_scene";
  id: string;
  width: number;
  height: number;
}

/** The residual of ``pair`` at the estimate or the true pose, or the reason for its absence. */
export interface ResidualView {
  pair: string;
  at: "estimate" | "truth";
  reason: string;
  px: number | null;
  across_px: number | null;
  along_px: number | null;
  chi2: number | null;
  limit: number | null;
  fits: boolean;
}

/** The submap in the right image of a frame. */
export interface RightImageEvent {
  type: "right_image";
  reply_to: string | null;
  position: number;
  mapped: Array<RightMapped>;
}

/** An element of the submap in the right image. */
export interface RightMapped {
  estimate: [[number, number], [number, number] | null] | null;
  truth: [[number, number], [number, number] | null] | null;
}

/** Another run was opened. */
export interface RunEvent {
  type: "run";
  reply_to: string | null;
  run: RunView;
}

/** A fault of the map or the camera, with the frame that shows it best. */
export interface RunFaultView {
  kind: string;
  sentence: string;
  evidence: Array<[string, string]>;
  frames: Array<number>;
  element: number | null;
  observed: number | null;
  position: number;
}

/** The diagnosis of a run; ``compared`` counts the frames that it is based on. */
export interface RunFindings {
  compared: number;
  faults: Array<RunFaultView>;
  rows: Array<ElementRow>;
}

/** Method, map, classes and image sizes of a run; of a rig, its camera. */
export interface RunHead {
  name: string;
  method: string;
  map: string;
  map_frame: string;
  created: string;
  elements: number;
  image: ImageSize;
  image_right: ImageSize | null;
  camera: string;
  classes: Array<ElementClassView>;
}

/** Everything about a run that does not depend on the frame shown. */
export interface RunView {
  name: string;
  method: string;
  map: string;
  map_frame: string;
  created: string;
  elements: number;
  image: ImageSize;
  image_right: ImageSize | null;
  camera: string;
  classes: Array<ElementClassView>;
  note: string;
  frames: FrameColumns;
  median_m: number | null;
  ok_share: number;
}

/** The runs that can be opened. */
export interface RunsEvent {
  type: "runs";
  reply_to: string | null;
  names: Array<string>;
}

/** Save the frames of a finished sweep as a run. */
export interface SaveSweepRequest {
  type: "save_sweep";
  id: string;
}

/** The 3D scene can be opened. */
export interface SceneEvent {
  type: "scene";
  reply_to: string | null;
}

/** The 3D pane as a PNG file, base64. */
export interface SceneImageEvent {
  type: "scene_image";
  reply_to: string | null;
  png: string;
}

/** A candidate pose of the search; ``score`` and ``behind`` (the best) in nats. */
export interface SearchPoseView {
  letter: string;
  score: number | null;
  behind: number | null;
  share: number;
  pairs: number | null;
  from_answer: PoseDifference | null;
  from_truth: PoseDifference | null;
}

/** Numbers of poses evaluated and consistent with the prior, and the best poses. */
export interface SearchView {
  tried: number;
  passed: number | null;
  poses: Array<SearchPoseView>;
}

/** Select a detection, a map element, a pair of them, or nothing. */
export interface SelectRequest {
  type: "select";
  id: string;
  observed?: number | null;
  element?: number | null;
}

/** The selected detection, element or pair. */
export interface SelectionCard {
  observed: number | null;
  element: number | null;
  name: string;
  class_id: number;
  summary: Array<string>;
  residuals: Array<ResidualView>;
  of_row: Array<MatrixCell>;
  of_column: Array<MatrixCell>;
  mapped: ElementCard | null;
}

/** The selection; null where nothing is selected. */
export interface SelectionEvent {
  type: "selection";
  reply_to: string | null;
  card: SelectionCard | null;
}

/** Show or hide the backdrop in 3D; one that was made meanwhile is found. */
export interface SetBackdropRequest {
  type: "set_backdrop";
  id: string;
  shown: boolean;
}

/** Choose the image and what is drawn on it. Null: leave as it is. */
export interface SetImageRequest {
  type: "set_image";
  id: string;
  mode?: "estimate" | "truth" | "pairs" | "error" | null;
  side?: "left" | "right" | null;
  neighbours?: boolean | null;
}

/** Colour the 3D map. Null: leave as it is. */
export interface SetMapColorsRequest {
  type: "set_map_colors";
  id: string;
  colors?: "class" | "residual" | "times" | null;
  ellipsoids?: boolean | null;
}

/** Use dark or light colours. */
export interface SetThemeRequest {
  type: "set_theme";
  id: string;
  theme: "dark" | "light";
}

/** Look from a named viewpoint in 3D. */
export interface SetViewRequest {
  type: "set_view";
  id: string;
  view: "behind" | "above" | "camera" | "free";
}

/** A setting or input of both runs. */
export interface SetupRow {
  what: string;
  base: string;
  other: string;
}

/** Show or hide the alternative poses. */
export interface ShowAlternativesRequest {
  type: "show_alternatives";
  id: string;
  shown: boolean;
}

/** Show or hide the expected error along the route. */
export interface ShowForecastRequest {
  type: "show_forecast";
  id: string;
  shown: boolean;
}

/** Show a candidate pose of the search in 3D. Null: hide it. */
export interface ShowSearchPoseRequest {
  type: "show_search_pose";
  id: string;
  row: number | null;
}

/** A result of the solver; errors are null without a pose or ground truth. */
export interface SolutionView {
  status: "ok" | "ambiguous" | "cannot";
  error_m: number | null;
  error_deg: number | null;
  inliers: number;
  detections: number;
}

/** Solve the frame with the suggested change. */
export interface SolveSuggestionRequest {
  type: "solve_suggestion";
  id: string;
}

/** Solve the frame with a change, in addition to the kept changes. */
export interface SolveWhatIfRequest {
  type: "solve_what_if";
  id: string;
  change: Record<string, number | string>;
}

/** A pair of the estimate. */
export interface SolvedPair {
  observed: number;
  element: number;
  name: string;
  class_id: number;
  inlier: boolean;
  is_true: boolean | null;
  residual_px: number | null;
  chi2: number | null;
  support_nats: number | null;
  open_m: number | null;
}

/** How a frame was solved; stages that the method lacks are null. */
export interface SolverEvent {
  type: "solver";
  reply_to: string | null;
  position: number;
  stages: Array<[string, number]>;
  search: SearchView | null;
  pairs: Array<SolvedPair> | null;
  trace: TraceView | null;
  notes: Array<string>;
  shown: number | null;
}

/** An element of the map that has not changed. */
export interface StandingElement {
  name: string;
  class_id: number;
  place: [number, number];
}

/** The selection or the display settings changed. */
export interface StateEvent {
  type: "state";
  reply_to: string | null;
  state: StateView;
}

/** The selection and the display settings. */
export interface StateView {
  observed: number | null;
  element: number | null;
  view: "behind" | "above" | "camera" | "free";
  alternatives: boolean;
  forecast: boolean;
  colors: "class" | "residual" | "times";
  ellipsoids: boolean;
  backdrop: boolean;
  base: string;
  comparing: boolean;
  mode: "estimate" | "truth" | "pairs" | "error";
  side: "left" | "right";
  neighbours: boolean;
}

/** Stop rebuilding. */
export interface StopRebuildRequest {
  type: "stop_rebuild";
  id: string;
}

/** Stop the sweep; the frames solved so far count. */
export interface StopSweepRequest {
  type: "stop_sweep";
  id: string;
}

/** A cause of wrong frames; ``frames`` and ``examples`` are positions. */
export interface StoryCause {
  kind: string;
  sentence: string;
  where: string;
  is_of_run: boolean;
  frames: Array<number>;
  examples: Array<number>;
  parts: Array<number>;
}

/** The story of the run, None if it is as before, and the progress of its diagnosis. It has no causes of the run as a whole while ``progress`` has text. */
export interface StoryEvent {
  type: "story";
  reply_to: string | null;
  progress: string;
  diagnosed: number;
  found: StoryView | null;
}

/** A part of the route: map points (m), its frames and wrong frames, and the worst one. */
export interface StoryPart {
  points: Array<[number, number]>;
  frames: number;
  wrong: number;
  position: number;
}

/** The story of a run. Counts are of frames. */
export interface StoryView {
  headline: string;
  detail: string;
  length_m: number;
  seconds: number | null;
  median_m: number | null;
  ok: number;
  ambiguous: number;
  cannot: number;
  overconfident: number | null;
  causes: Array<StoryCause>;
  harmless: Array<StoryCause>;
  route: Array<StoryPart>;
}

/** Find the change most likely to explain the failure of this frame. */
export interface SuggestWhatIfRequest {
  type: "suggest_what_if";
  id: string;
}

/** A landmark worth adding to the map, and the first frame that it improves. */
export interface SuggestedElement {
  position: number | null;
  text: string;
}

/** The change most likely to explain the failure of a frame, and its result. */
export interface SuggestionEvent {
  type: "suggestion";
  reply_to: string | null;
  position: number;
  text: string;
  before: SolutionView;
  after: SolutionView;
}

/** Why no suggestion was solved; empty where one was. */
export interface SuggestionStatusEvent {
  type: "suggestion_status";
  reply_to: string | null;
  text: string;
}

/** Progress of a sweep, or its result. */
export interface SweepView {
  is_over: boolean;
  can_save: boolean;
  text: string;
  changed: Array<ChangedFrame>;
}

/** Solve all frames that the kept changes affect. */
export interface SweepWhatIfRequest {
  type: "sweep_what_if";
  id: string;
}

/** Cost and step of each iteration, and the distance from the best pose of the search. */
export interface TraceView {
  cost: Array<number | null>;
  steps: Array<PoseDifference>;
  moved: PoseDifference | null;
}

/** Undo a review decision that was made here. */
export interface UndoAnswerRequest {
  type: "undo_answer";
  id: string;
  key: string;
  base?: EditBase | null;
}

/** Undo the last decision on changes that was made on this page. */
export interface UndoChangeAnswerRequest {
  type: "undo_change_answer";
  id: string;
  seen: number;
}

/** Undo the last label edit that was made here. */
export interface UndoLabelEditRequest {
  type: "undo_label_edit";
  id: string;
  base?: EditBase | null;
}

/** The user's viewpoint in 3D, metres in the map frame. */
export interface ViewpointEvent {
  type: "viewpoint";
  reply_to: string | null;
  eye: [number, number, number];
  target: [number, number, number];
}

/** The pending change, the kept changes, and their result. */
export interface WhatIfEvent {
  type: "what_if";
  reply_to: string | null;
  change: string;
  kept: Array<string>;
  file: string;
  solving: boolean;
  failure: string;
  result: WhatIfResult | null;
  sweep: SweepView | null;
  saved: string;
}

/** Changes of one subject, for example the selected element. */
export interface WhatIfGroup {
  title: string;
  options: Array<WhatIfOption>;
}

/** A change: a button, a choice, or numbers to enter. */
export interface WhatIfOption {
  text: string;
  change: Record<string, number | string>;
  choice: ChoiceField | null;
  fields: Array<NumberField>;
}

/** The changes that fit the selection and the frame. */
export interface WhatIfOptionsEvent {
  type: "what_if_options";
  reply_to: string | null;
  groups: Array<WhatIfGroup>;
}

/** A frame before and after the changes. */
export interface WhatIfResult {
  position: number;
  has_effect: boolean;
  before: SolutionView;
  after: SolutionView;
  reason: string;
  ms: number;
  mapped: Array<MappedElement>;
}

/** Write the map after the decided changes as a new map of the workspace. */
export interface WriteChangedMapRequest {
  type: "write_changed_map";
  id: string;
  name: string;
}

/** The label operation that last changed a label element. */
export interface WriterView {
  author: string;
  origin: string;
  time: string;
  number: number;
  kind: string;
}

export interface Requests {
  answer_decision: AnswerDecisionRequest;
  check_gates: CheckGatesRequest;
  compare_runs: CompareRunsRequest;
  decide_changes: DecideChangesRequest;
  draw_frame: DrawFrameRequest;
  drop_what_if: DropWhatIfRequest;
  exclude_element: ExcludeElementRequest;
  find_frames: FindFramesRequest;
  forget_what_if: ForgetWhatIfRequest;
  get_decisions: GetDecisionsRequest;
  get_elements: GetElementsRequest;
  get_label_edits: GetLabelEditsRequest;
  get_origins: GetOriginsRequest;
  get_over_time: GetOverTimeRequest;
  get_solver: GetSolverRequest;
  get_story: GetStoryRequest;
  get_viewpoint: GetViewpointRequest;
  get_what_if_options: GetWhatIfOptionsRequest;
  go_to_change: GoToChangeRequest;
  go_to_decision: GoToDecisionRequest;
  go_to_position: GoToPositionRequest;
  go_to_viewpoint: GoToViewpointRequest;
  keep_map: KeepMapRequest;
  keep_what_if: KeepWhatIfRequest;
  merge_duplicates: MergeDuplicatesRequest;
  open_asked_label: OpenAskedLabelRequest;
  open_label: OpenLabelRequest;
  open_run: OpenRunRequest;
  rebuild_map: RebuildMapRequest;
  render_scene: RenderSceneRequest;
  save_sweep: SaveSweepRequest;
  select: SelectRequest;
  set_backdrop: SetBackdropRequest;
  set_image: SetImageRequest;
  set_map_colors: SetMapColorsRequest;
  set_theme: SetThemeRequest;
  set_view: SetViewRequest;
  show_alternatives: ShowAlternativesRequest;
  show_forecast: ShowForecastRequest;
  show_search_pose: ShowSearchPoseRequest;
  solve_suggestion: SolveSuggestionRequest;
  solve_what_if: SolveWhatIfRequest;
  stop_rebuild: StopRebuildRequest;
  stop_sweep: StopSweepRequest;
  suggest_what_if: SuggestWhatIfRequest;
  sweep_what_if: SweepWhatIfRequest;
  undo_answer: UndoAnswerRequest;
  undo_change_answer: UndoChangeAnswerRequest;
  undo_label_edit: UndoLabelEditRequest;
  write_changed_map: WriteChangedMapRequest;
}

export interface Events {
  backdrop: BackdropEvent;
  base_frame: BaseFrameEvent;
  change_answers: ChangeAnswersEvent;
  changed_map: ChangedMapEvent;
  comparison: ComparisonEvent;
  decisions: DecisionsEvent;
  element_frames: ElementFramesEvent;
  elements: ElementsEvent;
  error: ErrorEvent;
  forecast: ForecastEvent;
  frame: FrameEvent;
  gates: GatesEvent;
  hello: HelloEvent;
  label_edits: LabelEditsEvent;
  label_page: LabelPageEvent;
  map_colors: MapColorsEvent;
  map_saved: MapSavedEvent;
  neighbours: NeighboursEvent;
  origins: OriginsEvent;
  over_time: OverTimeEvent;
  reading: ReadingEvent;
  right_image: RightImageEvent;
  run: RunEvent;
  runs: RunsEvent;
  scene: SceneEvent;
  scene_image: SceneImageEvent;
  selection: SelectionEvent;
  solver: SolverEvent;
  state: StateEvent;
  story: StoryEvent;
  suggestion: SuggestionEvent;
  suggestion_status: SuggestionStatusEvent;
  viewpoint: ViewpointEvent;
  what_if: WhatIfEvent;
  what_if_options: WhatIfOptionsEvent;
}

}
