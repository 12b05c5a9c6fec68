// English words for what the API enumerates.
import type {
  BindingLimit,
  Cause,
  GateCause,
  LinkState,
  MissionState,
  PauseCause,
  RobotMode,
  Right,
  Role,
  StandstillState,
  TerrainClass,
} from '../api/schema';

export const link: Record<LinkState, string> = { online: 'online', stale: 'delayed', offline: 'offline' };
export const mode: Record<RobotMode, string> = {
  idle: 'idle',
  tracking: 'on a mission',
  teleoperated: 'teleoperated',
  stopped: 'stopped',
  fault: 'fault',
};
export const missionState: Record<MissionState, string> = {
  queued: 'waiting',
  offered: 'offered',
  active: 'driving',
  paused: 'paused',
  cancelling: 'ending',
  succeeded: 'succeeded',
  failed: 'failed',
  cancelled: 'cancelled',
  rejected: 'rejected',
  expired: 'expired',
};
export const cause: Record<Cause, string> = {
  requested: 'asked for',
  offered: 'offered to the robot',
  returned: 'given back by the robot',
  accepted: 'the robot has taken it',
  rejected: 'the robot refuses it',
  pause_requested: 'a pause is asked for',
  paused: 'the robot stands',
  resume_requested: 'going on is asked for',
  resumed: 'the robot goes on',
  replace_requested: 'another path is asked for',
  replaced: 'the robot has the other path',
  replace_refused: 'the robot refuses the other path',
  cancel_requested: 'its end is asked for',
  superseded: 'another mission took its place',
  cancelled: 'ended before its path did',
  succeeded: 'driven to its end',
  failed: 'the robot could not go on',
  expired: 'waited too long',
  robot_lost: 'the robot is not heard',
  agent_restarted: 'the robot started afresh',
  robot_lost_mission: 'the robot no longer knows it',
  robot_retired: 'the robot is retired',
  recorded: 'recorded',
};
export const limit: Record<BindingLimit, string> = {
  lateral_acceleration: 'lateral acceleration',
  angular_speed: 'turn rate',
  wheel_speed: 'wheel speed',
  wheel_acceleration: 'wheel acceleration',
  linear_acceleration: 'acceleration',
  traction: 'traction limit of the ground',
};
export const gate: Record<GateCause, string> = {
  acceleration: 'acceleration limit',
  speed: 'speed limit',
  command_age: 'commands come late',
  external_limit: 'limited from outside',
  fence: 'near the fence',
  not_finite: 'command is no number',
  no_command: 'no command',
  lease: 'last command has ended',
  link_policy: 'server not heard',
  external_hold: 'held from outside',
  loop_overrun: 'control loop is late',
  sensor_fault: 'sensors contradict each other',
  stale_position: 'position is old',
  tilt: 'leans too much',
  stale_feedback: 'base is silent',
  stop: 'stop',
  other: 'another reason',
};
export const pausedBy: Record<PauseCause, string> = {
  request: 'on request',
  teleoperation: 'teleoperated',
  stop: 'stopped',
  other: 'another reason',
};
export const terrainClass: Record<TerrainClass, string> = {
  asphalt: 'asphalt',
  concrete: 'concrete',
  paving: 'paving',
  gravel: 'gravel',
  soil: 'soil',
  grass: 'grass',
  sand: 'sand',
  mud: 'mud',
  snow: 'snow',
  ice: 'ice',
  wood: 'wood',
  metal: 'metal',
  other: 'other',
};
export const role: Record<Role, string> = { viewer: 'viewer', operator: 'operator', admin: 'admin' };

export const right: Record<Right, string> = {
  stop: 'stop',
  read: 'read',
  drive: 'drive',
  clear_stop: 'clear stops',
  hold: 'hold',
  release_hold: 'release holds',
  dispatch: 'dispatch',
  acknowledge: 'acknowledge',
  configure: 'configure',
  administer: 'administer',
};

export const standstill: Record<StandstillState, string> = {
  stopping: 'stopping',
  standstill: 'stopped, stands still',
  standstill_not_reached: 'STILL MOVING',
  unexpected_motion: 'MOVES WHILE STOPPED',
  other: 'stopped',
};

/** What codes of alerts mean: the table of `docs/rest.md`. */
export const alertTitles = {
  'two-agents': 'Two agents under one name',
  'storage-unwritable': 'The server cannot store anything',
  'database-damaged': 'The database is damaged',
  'disk-low': 'The server’s disk is nearly full',
  'server-restarted': 'The server was restarted',
  'certificate-expiring': 'The server’s certificate expires',
  'archive-failed': 'Measurements cannot be archived',
  'backup-failed': 'The backup failed',
  'backup-old': 'The newest backup is old',
  'robots-await-release': 'Robots await their release',
  'mission-failed': 'Mission failed',
  'mission-expired': 'Mission expired',
  'mission-rejected': 'Mission rejected',
  'mission-waiting': 'Mission does not begin',
  'robot-waiting': 'Robot does not continue its mission',
  'clock-wrong': 'Robot’s clock is wrong',
  'robot-lost': 'No contact with the robot',
  'stop-unconfirmed': 'Stop not confirmed',
  'revoked-robot': 'Revoked robot reports',
  'retired-authority': 'Certificate of a retired authority',
  'unknown-certificate': 'Unknown certificate',
  'standstill-not-reached': 'Robot is still moving',
  'moves-while-stopped': 'Robot moves while it is stopped',
  stopped: 'Robot is stopped',
  'dug-in': 'Robot is dug in',
  'payload-changed': 'Payload has changed',
  'wheels-and-motion-disagree': 'Wheels and motion disagree',
  'wheel-locked': 'A wheel is locked',
  'sensor-frozen': 'A sensor always reports the same',
  'sensor-inconsistent': 'A sensor contradicts the others',
  'battery-critical': 'Battery is nearly empty',
  'battery-low': 'Battery is low',
  'base-silent': 'Base does not answer',
  'base-restarted': 'Base was restarted',
  'base-clock': 'Base has set its clock anew',
  'position-lost': 'Position is lost',
  'command-second-writer': 'Another node commands the base',
  'outbox-long': 'Many measurements wait',
  'outbox-damaged': 'Stored measurements are damaged',
  'outbox-dropped': 'Measurements were lost',
  'surface-change': 'Ground has changed',
  'loop-overrun': 'Control loop is late',
} as const;
export type AlertKind = keyof typeof alertTitles;

/** What has happened when an alert of a code is raised, to the robot that is named. */
export const alertSentences: Readonly<Record<AlertKind, (robot: string) => string>> = {
  'two-agents': (robot) => `Two agents are connected under the name ${robot}.`,
  'storage-unwritable': () => 'The server cannot write to its storage: nothing new is kept.',
  'database-damaged': () => 'The database of the server is damaged.',
  'disk-low': () => 'The disk of the server is nearly full.',
  'server-restarted': () => 'The server was restarted.',
  'certificate-expiring': () => 'The certificate of the server has expired or expires soon.',
  'archive-failed': () => 'Old measurements cannot be archived. They stay in the database.',
  'backup-failed': () => 'The last attempt at a backup failed.',
  'backup-old': () => 'The newest backup is older than two backup intervals.',
  'robots-await-release': () => 'The server was restored from a backup. Robots get no missions until they are released.',
  'mission-failed': (robot) => `A mission of ${robot} failed.`,
  'mission-expired': (robot) => `A mission of ${robot} waited too long and expired.`,
  'mission-rejected': (robot) => `${robot} rejected a mission.`,
  'mission-waiting': (robot) => `The next mission of ${robot} has not begun for 5 minutes.`,
  'robot-waiting': (robot) => `${robot} has made no progress on its mission for 5 minutes.`,
  'clock-wrong': (robot) => `The clock of ${robot} is more than 10 s from that of the server.`,
  'robot-lost': (robot) => `Nothing has arrived from ${robot} for at least 15 s.`,
  'stop-unconfirmed': (robot) => `${robot} has not confirmed its stop.`,
  'revoked-robot': (robot) => `${robot} is revoked and tries to connect.`,
  'retired-authority': (robot) => `${robot} has a certificate of a retired authority and has to join again.`,
  'unknown-certificate': (robot) => `A certificate of ${robot} is not known to the server. The robot has to join again.`,
  'standstill-not-reached': (robot) => `${robot} is commanded to rest, but it is still moving.`,
  'moves-while-stopped': (robot) => `${robot} is commanded to rest and stood, but it moves again.`,
  stopped: (robot) => `A stop of ${robot} is in force.`,
  'dug-in': (robot) => `The wheels of ${robot} turn, but the robot does not move.`,
  'payload-changed': (robot) => `${robot} was loaded or unloaded: its apparent mass has changed.`,
  'wheels-and-motion-disagree': (robot) => `The wheels of ${robot} and its measured motion contradict each other.`,
  'wheel-locked': (robot) => `A wheel of ${robot} does not turn.`,
  'sensor-frozen': (robot) => `A sensor of ${robot} always reports the same value.`,
  'sensor-inconsistent': (robot) => `A sensor of ${robot} contradicts the others.`,
  'battery-critical': (robot) => `The battery of ${robot} fell below 5 %.`,
  'battery-low': (robot) => `The battery of ${robot} fell below 20 %.`,
  'base-silent': (robot) => `The base of ${robot} sends no messages. The robot is in fault.`,
  'base-restarted': (robot) => `The base of ${robot} was restarted.`,
  'base-clock': (robot) => `The clock of the base of ${robot} was set.`,
  'position-lost': (robot) => `${robot} has no position. The robot is in fault.`,
  'command-second-writer': (robot) => `Another ROS 2 node commands the base of ${robot}.`,
  'outbox-long': (robot) => `Many measurements of ${robot} wait for upload.`,
  'outbox-damaged': (robot) => `Stored measurements on the disk of ${robot} were damaged.`,
  'outbox-dropped': (robot) => `Measurements of ${robot} were lost.`,
  'surface-change': (robot) => `${robot} has measured ground that differs from the friction map.`,
  'loop-overrun': (robot) => `The control loop of ${robot} is late. The robot is held.`,
};

/** The sentence of an alert; null for a code that is not known here. */
export function alertSentence(
  code: string,
  robot: string,
  sentences: typeof alertSentences,
  ofBase: (robot: string) => string,
): string | null {
  if (Object.hasOwn(sentences, code)) return sentences[code as AlertKind](robot);
  return code.startsWith('base-') ? ofBase(robot) : null;
}

/** The title of an alert; a code that is not known here is its own title. */
export function alertTitle(code: string, titles: Readonly<Record<AlertKind, string>>, ofBase: string): string {
  if (Object.hasOwn(titles, code)) return titles[code as AlertKind];
  return code.startsWith('base-') ? ofBase : code;
}

/** How points are drawn: with a mouse and keys, or with a finger. */
export function howToDraw(what: string, isTouch: boolean): string {
  return isTouch
    ? `Tap on the map to add a ${what}, drag a ${what} to move it, long-press it to delete it.`
    : `Click on the map to add a ${what}, drag a ${what} to move it, right-click to delete it; by keys: move the map, Enter adds its centre.`;
}
