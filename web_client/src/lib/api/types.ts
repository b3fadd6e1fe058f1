/** Shapes of the relay's HTTP API, under the names that the portal uses.
 *
 * They are the relay's own: `schema.d.ts` is made of its OpenAPI document by `make api-types`, and is not edited by hand.
 * Messages over the websocket of a robot are not in that document; those that the portal reads are in `../ros/messages.ts`.
 */
import type { components } from './schema'

type Schemas = components['schemas']

export type Level = Schemas['Level']
export type Session = Schemas['CurrentUser']
export type Credentials = Schemas['LoginBody']

export type Robot = Schemas['RobotInfo']
export type RobotState = Robot['state']
export type Client = Schemas['ClientInfo']
export type LinkFacts = Schemas['LinkQualityInfo']
export type Quality = LinkFacts['quality']
export type Person = Schemas['RobotUser']
export type Connection = Schemas['ConnectionInfo']
/** A service or action. */
export type Provided = Schemas['Provided']
export type Camera = Schemas['CameraInfo']
/** Messages of `/relay/control` have the same shape. */
export type Control = Schemas['ControlInfo']
export type Holder = Schemas['HolderInfo']
export type ControlRequest = Schemas['ControlRequestInfo']
export type Stopped = Schemas['StopInfo']
/** What `/api/v1/robots/stream` sends: the data of each event. */
export type Update = Schemas['RobotsUpdate'] | Schemas['AlertsUpdate'] | Schemas['UpdateUnknown']

export type Alert = Schemas['AlertInfo']
export type AlertLevel = Alert['level']
export type AlertPage = Schemas['AlertPage']

export type Recording = Schemas['RecordingInfo']
export type RecordingState = Recording['state']
export type RecordingPage = Schemas['RecordingPage']
export type Recordable = Schemas['Recordable']
export type RecordingRequest = Schemas['RecordingRequest']

/** Fields with a default are always sent. */
export type ModuleStatus = Required<Schemas['ModuleStatus']>
export type ModuleList = Schemas['ModuleList'] & { modules: ModuleStatus[] }
/** Fields with a default are always sent. */
export type PipeStatus = Required<Omit<Schemas['PipeStatus'], 'source' | 'target' | 'fields'>> & {
  source: Required<Schemas['PipeEnd']>
  target: Required<Schemas['PipeEnd']>
  fields: Required<Schemas['FieldMapping']>[]
}
export type ProgramInfo = Schemas['ProgramInfo']
export type NewPipe = Schemas['NewPipe']
export type RoleInfo = Schemas['RoleInfo']
/** Fields with a default are always sent. */
export type RoleRun = Required<Schemas['RoleRunState']>
export type ElementValue = Schemas['ElementValue']
export type ElementDone = Schemas['ElementDone']
export type FoxgloveUrl = Schemas['FoxgloveUrl']
export type FoxgloveUrls = Schemas['FoxgloveUrls']
export type MadeFoxgloveUrl = Schemas['MadeFoxgloveUrl']
export type NewFoxgloveUrl = Schemas['NewFoxgloveUrl']
export type FilePage = Schemas['FilePage']
export type FileInfo = Schemas['FileInfo']
export type UploadInfo = Schemas['UploadInfo']
export type FunctionList = Schemas['FunctionList']
export type FunctionStatus = Schemas['FunctionStatus']
export type JobStatus = Schemas['JobStatus']
export type ClusterState = Schemas['ClusterState']
export type RelayStatus = Schemas['RelayStatus']
export type DeviceInfo = Schemas['DeviceInfo']
export type LogPage = Schemas['ModuleLogPage']
export type LogLine = Schemas['LogLine']
export type ProcessStatus = Required<Schemas['ProcessStatus']>
export type ProcessList = Schemas['ProcessList'] & { processes: ProcessStatus[] }

export type Order = Schemas['Order']
export type OrderKind = Order['do']
/** One line of the answer to an order. */
export type OrderLine = Schemas['FleetOrderStart'] | OrderResult | Schemas['FleetOrderEnd']
export type OrderResult = Schemas['FleetRobotResult']

export type RealmAbout = Schemas['RealmAbout']
export type RealmUser = Schemas['RealmUser']
export type UserChange = Schemas['UserChange']
export type RealmGroup = Schemas['RealmGroup']
export type RealmRobot = Schemas['RealmRobot']
/** Enrolment code of a robot; shown once. */
export type Enrolment = Schemas['RealmCode']
export type RealmKey = Schemas['RealmKey']
export type RealmRight = Schemas['RealmRight']
export type RealmToken = Schemas['RealmToken']
