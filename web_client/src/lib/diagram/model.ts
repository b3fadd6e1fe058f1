/** Elements of robots, programs and Roles, and what a line from one to another means. */
import { endText } from '../api/pipes'
import type { NewPipe, PipeStatus, ProgramInfo } from '../api/types'
import { type Field, fieldsOf, misfit, type TypeDef, typeAt } from './fields'
import { addressOf, type Bound, boundTo, type Item, type Lane, type RoleParts } from './roleDocument'

/** A topic, or a field of it. */
export interface Place {
  robot: string
  topic: string
  /** Full type of the messages; empty if it is not known. */
  type: string
  /** Empty for whole messages. */
  path: string
}

/** What a pipe would have at an element. */
export interface End {
  at: NewPipe['source']
  /** Full type of the messages; empty if it is not known, and for programs. */
  type: string
  /** Empty for the whole. */
  path: string
}

export interface Element {
  id: string
  /** Id of the robot, program or Role that has it. */
  node: string
  /** Name of the robot, program or Role. */
  owner: string
  name: string
  /** An argument is a field of a service's requests or an action's goals, a reply one of its answers or results. */
  kind: 'topic' | 'field' | 'service' | 'action' | 'argument' | 'reply' | 'port' | 'function' | 'item'
  /** Type for people: of messages, of the field, or of the item. */
  type: string
  /** Where its value comes from; null without a topic. */
  place: Place | null
  /** Null for what can be no end of a pipe. */
  end: End | null
  /** Basic type of a field; null if it is none, or not known. */
  basic: string | null
  /** Whether lines may begin and end here. */
  gives: boolean
  takes: boolean
  /** Whether it moves the robot. */
  moves: boolean
  /** Of an item in a Role. */
  item: Item | null
  /** Resources that an item is bound to. */
  bound: Bound[]
}

export interface Topic {
  name: string
  types: string[]
  publishers: string[]
  subscribers: string[]
  moves: boolean
}

/** A service or an action. */
export interface Service {
  name: string
  types: string[]
  moves: boolean
}

export interface RobotParts {
  name: string
  online: boolean
  topics: Topic[]
  services: Service[]
  actions: Service[]
}

export const robotId = (robot: string) => `robot:${robot}`
export const programId = (program: string) => `program:${program}`
export const roleId = (role: string) => `role:${role}`
export const topicId = (robot: string, topic: string) => `${robotId(robot)} ${topic}`
export const fieldId = (robot: string, topic: string, path: string) => `${topicId(robot, topic)}#${path}`
export const serviceId = (robot: string, service: string) => `${robotId(robot)} ${service}()`
export const actionId = (robot: string, action: string) => `${robotId(robot)} ${action}{}`
/** @param called id of the service or action */
export const argumentId = (called: string, path: string) => `${called}#${path}`
export const replyId = (called: string, path: string) => `${called}# ${path}`
export const partId = (program: string, part: string) => `${programId(program)} ${part}`
export const itemId = (role: string, iri: string) => `${roleId(role)} ${iri}`

/** Topics that tools use, not people. */
const PLUMBING = /^\/(relay|rosapi|parameter_events|rosout|robot_description|client_count|connected_clients)(\/|$)|\/_|^\/diagnostics(_agg)?$/
const TOOLS = /\/(get|set|list|describe)_(parameters?|parameter_types|parameters_atomically|type_description)(_atomically)?$|^\/(relay|rosapi)\/|\/_/

/** The node under which the relay's own endpoints are listed: a page that shows a value is no subscriber of the robot. */
const RELAY = '/relay'

/** Topics, services and actions of a robot. */
export function elementsOfRobot({ name, topics, services, actions }: RobotParts): Element[] {
  const node = robotId(name)
  const shared = { node, owner: name, basic: null, item: null, bound: [] }
  return [
    ...topics
      .filter((topic) => !PLUMBING.test(topic.name))
      .map((topic): Element => {
        const type = topic.types[0] ?? ''
        return {
          ...shared,
          id: topicId(name, topic.name),
          name: topic.name,
          kind: 'topic',
          type,
          place: { robot: name, topic: topic.name, type, path: '' },
          end: { at: { robot: name, topic: topic.name }, type, path: '' },
          gives: others(topic.publishers).length > 0,
          takes: others(topic.subscribers).length > 0 || others(topic.publishers).length === 0,
          moves: topic.moves,
        }
      }),
    ...services
      .filter((service) => !TOOLS.test(service.name))
      .map((service): Element => {
        const [id, type] = [serviceId(name, service.name), service.types[0] ?? '']
        const end = { at: { robot: name, service: service.name }, type, path: '' }
        return { ...shared, id, name: service.name, kind: 'service', type, place: null, end, gives: true, takes: true, moves: service.moves }
      }),
    ...actions
      .filter((action) => !TOOLS.test(action.name))
      .map((action): Element => {
        const [id, type] = [actionId(name, action.name), action.types[0] ?? '']
        const end = { at: { robot: name, action: action.name }, type, path: '' }
        return { ...shared, id, name: action.name, kind: 'action', type, place: null, end, gives: true, takes: true, moves: action.moves }
      }),
  ]
}

/** Ports and functions of a program. */
export function elementsOfProgram({ name, ports, functions }: ProgramInfo): Element[] {
  const node = programId(name)
  const shared = { node, owner: name, place: null, basic: null, gives: true, takes: true, moves: false, item: null, bound: [] }
  const part = (kind: 'port' | 'function') => (part: string): Element => ({
    ...shared,
    id: partId(name, part),
    name: part,
    kind,
    type: kind,
    end: { at: { program: name, [kind]: part }, type: '', path: '' },
  })
  return [...ports.map(part('port')), ...functions.map(part('function'))]
}

function others(nodes: string[]): string[] {
  return nodes.filter((node) => node !== RELAY)
}

/** Fields of a topic.
 *
 * @param message the newest one, which shows how long lists are
 */
export function elementsOfTopic(topic: Element, definitions: TypeDef[], message: unknown): Element[] {
  const place = topic.place
  if (place === null) return []
  return fieldsOf(definitions, message).map((field) => ({
    ...topic,
    id: fieldId(place.robot, place.topic, field.path),
    name: field.path,
    kind: 'field',
    type: field.type,
    place: { ...place, path: field.path },
    end: topic.end === null ? null : { ...topic.end, path: field.path },
    basic: field.type,
    takes: topic.takes && !field.indexed,
  }))
}

/** Arguments and fields of the replies of a service, or of the goals and results of an action.
 *
 * @param request definitions of its requests or goals
 * @param response definitions of its replies or results
 */
export function elementsOfCalled(called: Element, request: TypeDef[], response: TypeDef[]): Element[] {
  const end = called.end
  if (end === null) return []
  const made = (kind: 'argument' | 'reply', field: Field): Element => ({
    ...called,
    id: (kind === 'argument' ? argumentId : replyId)(called.id, field.path),
    name: field.path,
    kind,
    type: field.type,
    end: { ...end, path: field.path },
    basic: field.type,
    takes: kind === 'argument' && !field.indexed,
    gives: kind === 'reply',
  })
  return [
    ...fieldsOf(request).map((field) => made('argument', field)),
    ...fieldsOf(response).map((field) => made('reply', field)),
  ]
}

/** Whether an element can be opened. */
export function opens({ kind }: Element): boolean {
  return kind === 'topic' || kind === 'service' || kind === 'action'
}

/** Whether an element is a part of one that can be opened. */
export function isPart({ kind }: Element): boolean {
  return kind === 'field' || kind === 'argument' || kind === 'reply'
}

/** The id of the topic, service or action that an element is, or is a part of. */
export function wholeId({ id }: Pick<Element, 'id'>): string {
  return id.split('#')[0]!
}

/** The name of an element within its robot, program or Role. */
export function fullName({ kind, end, name }: Element): string {
  if (end === null) return name
  if (kind === 'field') return `${end.at.topic} ${name}`
  return kind === 'argument' || kind === 'reply' ? `${calledName(end.at)} ${name}` : name
}

/** The name of a service or action with the brackets by which users tell them from topics. */
function calledName({ service, action }: End['at']): string {
  return action ? `${action}{}` : `${service}()`
}

/** What is written behind the name of an element that is called. */
export function brackets({ kind }: Element): string {
  return kind === 'action' ? '{}' : kind === 'service' || kind === 'function' ? '()' : ''
}

const DATA = ['data', 'structuredData', 'field', 'port', 'element']
const CALLED = ['service', 'operation', 'function']

/** Elements of a Role.
 *
 * @param typeOf type of a topic, empty if it is not known
 * @param definitionsOf of a type at a robot, empty if they are not known
 */
export function elementsOfRole(
  role: string,
  { items }: RoleParts,
  typeOf: (robot: string, topic: string) => string,
  definitionsOf: (robot: string, type: string) => TypeDef[],
): Element[] {
  return items.map((item) => {
    const bound = item.resources.map(boundTo).filter((each) => each !== null)
    const topic = bound.find(({ kind }) => kind === 'topics')
    const place =
      topic === undefined ? null : { robot: topic.robot, topic: topic.name, type: typeOf(topic.robot, topic.name), path: topic.path }
    const basic = place === null || place.path === '' ? null : typeAt(definitionsOf(place.robot, place.type), place.path)
    const linked = DATA.includes(item.type) || CALLED.includes(item.type)
    return {
      id: itemId(role, item.iri),
      node: roleId(role),
      owner: role,
      name: item.name,
      kind: 'item',
      type: item.type,
      place,
      end: place === null ? null : { at: { robot: place.robot, topic: place.topic }, type: place.type, path: place.path },
      basic,
      gives: linked,
      takes: linked,
      moves: false,
      item,
      bound,
    }
  })
}

/** What a line from one element to another makes. */
export type Link =
  | { makes: 'pipe'; from: End; to: End; moves: boolean }
  | { makes: 'mapping'; role: string; from: string; to: string }
  | { makes: 'binding'; role: string; iri: string; resource: string }

/** The link from one element to another, or why there can be none, in words. */
export function linkOf(from: Element, to: Element): Link | string {
  if (from.id === to.id) return 'An element can’t be connected to itself.'
  if (!from.gives) return `${from.name} gives no values.`
  if (!to.takes) return `${to.name} takes no values.`
  if (from.item !== null && to.item !== null) return mapping(from, from.item, to, to.item)
  if (from.item === null && to.item === null) return pipe(from, to)
  return binding(from, to)
}

function pipe(from: Element, to: Element): Link | string {
  if (from.end === null || to.end === null) return 'Only topics, services, actions and programs can be connected.'
  if (endText(from.end.at) === endText(to.end.at)) return `${wholeName(from)} can’t be connected to itself.`
  if (from.end.at.program && to.end.at.program) return 'Programs send requests to each other; a pipe needs a robot at one end.'
  const [source, target] = [valueOf(from.end, to.end), valueOf(to.end, from.end)]
  return carried(from, to, source, target) ?? { makes: 'pipe', from: source, to: target, moves: to.moves }
}

/** The value of a program as a whole is its field `data`, where the other end is a field. */
function valueOf(end: End, other: End): End {
  return end.at.program && other.path !== '' ? { ...end, path: 'data' } : end
}

function wholeName({ kind, end, name }: Element): string {
  if (kind === 'field' || kind === 'topic') return 'A topic'
  return end !== null && (kind === 'argument' || kind === 'reply') ? calledName(end.at) : name
}

function mapping(from: Element, source: Item, to: Element, target: Item): Link | string {
  if (CALLED.includes(source.type) !== CALLED.includes(target.type)) {
    const [call, data] = CALLED.includes(source.type) ? [from, to] : [to, from]
    return `${call.name} is called and ${data.name} is data; only like elements can be mapped.`
  }
  if (source.mappings.includes(target.iri)) return 'They are mapped already.'
  if (from.end !== null && to.end !== null) {
    const wrong = carried(from, to, from.end, to.end)
    if (wrong !== null) return wrong
  }
  return { makes: 'mapping', role: from.owner, from: source.iri, to: target.iri }
}

function binding(from: Element, to: Element): Link | string {
  const [element, item] = from.item === null ? [from, to] : [to, from]
  if (element.end === null || item.item === null) return 'Only topics, services, actions and programs can be connected.'
  const called = brackets(element) !== ''
  if (CALLED.includes(item.type) && !called) return `${item.name} is called; it can’t stand for ${element.kind === 'port' ? 'a port' : 'a topic'}.`
  if (!CALLED.includes(item.type) && called) return `${element.name} is called; ${item.name} stands for data.`
  if (item.bound.length > 0) return `${item.name} stands for ${item.bound[0]!.text} already.`
  return { makes: 'binding', role: item.owner, iri: item.item.iri, resource: resourceOf(element.end) }
}

function resourceOf({ at, path }: End): string {
  const kind = at.service ? 'services' : at.action ? 'actions' : 'topics'
  return at.program ? endText(at) : addressOf(at.robot ?? '', at.topic || at.service || at.action || '', path, kind)
}

/** Why values can't be carried; null if they can, or if only the relay knows. */
function carried(from: Element, to: Element, source: End, target: End): string | null {
  if (source.path === '' && target.path === '') {
    if ((source.at.service || source.at.action) && target.at.topic) return `${from.name} replies and ${to.name} is a topic. Open both and connect a field to a field.`
    if (!(source.at.topic && target.at.topic)) return null
    if (source.type === target.type || source.type === '' || target.type === '') return null
    return `${from.name} has messages of ${source.type}, ${to.name} takes ${target.type}. Open both and connect a field to a field.`
  }
  const [whole, parts] = [wholeWords(source), wholeWords(target)]
  if (source.path === '') return `${from.name} is ${whole} and ${to.name} a field. Open ${from.name} and choose a field of it.`
  if (target.path === '') return `${from.name} is a field and ${to.name} ${parts}. Open ${to.name} and choose a field of it.`
  if (target.path.includes('[')) return `${target.path} is a value in a list, which can’t be set alone.`
  if (from.basic === null || to.basic === null) return null
  return misfit(asField(source, from.basic), asField(target, to.basic))
}

function wholeWords({ at }: End): string {
  return at.service ? 'a service' : at.action ? 'an action' : 'a whole message'
}

function asField({ path }: End, type: string): Field {
  return { path, type, indexed: path.includes('[') }
}

/** What undo changes at the relay: a pipe before and after, null for none. */
export interface PipeChange {
  before: NewPipe | null
  after: NewPipe | null
}

/** The pipe for a link. Fields of the same two topics share one pipe, since each message sets all fields.
 *
 * @param pipes those of the user
 */
export function pipeFor(link: Extract<Link, { makes: 'pipe' }>, pipes: PipeStatus[]): PipeChange | string {
  const { from, to } = link
  const same = pipes.find(
    ({ source, target, fields }) =>
      endText(source) === endText(from.at) && endText(target) === endText(to.at) && fields.length > 0 === (from.path !== ''),
  )
  if (same !== undefined) {
    if (same.fields.length === 0) return 'They are connected already.'
    if (same.fields.some(({ target }) => target === to.path)) return `${to.path} gets its value from another field already.`
    const before = settingsOf(same)
    return { before, after: { ...before, fields: [...(before.fields ?? []), field(from.path, to.path)], start: !link.moves } }
  }
  const after: NewPipe = {
    name: freeName(from, to, pipes),
    source: from.at,
    target: to.at,
    fields: from.path === '' ? [] : [field(from.path, to.path)],
    rate: 0,
    // A pipe that moves a robot begins when the user says so, not at the end of a drag.
    start: !link.moves,
  }
  return { before: null, after }
}

/** The settings with which a pipe can be added again. One that moves a robot does not start by itself. */
export function settingsOf({ name, source, target, fields, rate, state, moves }: PipeStatus): NewPipe {
  return { name, source, target, fields, rate, start: !moves && (state === 'running' || state === 'waiting') }
}

function field(source: string, target: string) {
  return { source, target, scale: 1, offset: 0 }
}

function freeName(from: End, to: End, pipes: PipeStatus[]): string {
  const base = `${endText(from.at)}-${endText(to.at)}`
    .toLowerCase()
    .replaceAll(/[^a-z0-9_]+/g, '-')
    .replace(/^[^a-z]+/, '')
    .slice(0, 58)
    .replace(/-+$/, '')
  const names = new Set(pipes.map(({ name }) => name))
  let name = base === '' ? 'pipe' : base
  for (let number = 2; names.has(name); number++) name = `${base === '' ? 'pipe' : base}-${number}`
  return name
}

/** A line in the diagram, and a connection in the table. */
export interface Line {
  id: string
  from: string
  to: string
  kind: 'pipe' | 'mapping'
  /** The pipe it belongs to. */
  pipe: PipeStatus | null
  /** The Role whose document has the mapping, with both IRIs. */
  mapping: { role: string; from: string; to: string } | null
}

/** Lines of pipes between elements. A line ends at a field where that is shown, else at its topic. */
export function linesOfPipes(pipes: PipeStatus[], shown: ReadonlySet<string>): Line[] {
  return pipes.flatMap((pipe) => {
    const ends = pipe.fields.length === 0 ? [{ source: '', target: '' }] : pipe.fields
    const lines = new Map<string, Line>()
    for (const { source, target } of ends) {
      const from = end(pipe.source, source, shown, replyId)
      const to = end(pipe.target, target, shown, argumentId)
      if (from === null || to === null) continue
      const id = `pipe ${pipe.owner} ${pipe.name} ${from} ${to}`
      lines.set(id, { id, from, to, kind: 'pipe', pipe, mapping: null })
    }
    return [...lines.values()]
  })
}

function end(at: PipeStatus['source'], path: string, shown: ReadonlySet<string>, inner: typeof argumentId): string | null {
  const { robot, topic, service, action, program } = at
  if (program !== '') return shown.has(partId(program, at.port || at.function)) ? partId(program, at.port || at.function) : null
  const called = service !== '' ? serviceId(robot, service) : action !== '' ? actionId(robot, action) : ''
  const outer = called || topicId(robot, topic)
  return innerOr(outer, called === '' ? fieldId(robot, topic, path) : inner(called, path), path, shown)
}

function innerOr(outer: string, inner: string, path: string, shown: ReadonlySet<string>): string | null {
  if (path !== '' && shown.has(inner)) return inner
  return shown.has(outer) ? outer : null
}

/** Lines of mappings within Roles, and across those that are shown. */
export function linesOfMappings(elements: Element[]): Line[] {
  const shown = new Set(elements.map(({ id }) => id))
  const roles = new Map<string, string[]>()
  for (const { item, owner } of elements) {
    if (item !== null) roles.set(item.iri, [...(roles.get(item.iri) ?? []), owner])
  }
  return elements.flatMap(({ id, item, owner }) =>
    (item?.mappings ?? []).flatMap((iri): Line[] => {
      const other = [owner, ...(roles.get(iri) ?? [])].find((role) => shown.has(itemId(role, iri)))
      if (other === undefined || item === null) return []
      const to = itemId(other, iri)
      return [{ id: `mapping ${id} ${to}`, from: id, to, kind: 'mapping', pipe: null, mapping: { role: owner, from: item.iri, to: iri } }]
    }),
  )
}

export const LANE_WORDS: Record<Lane, string> = { subject: 'Subject', action: 'Action', directObject: 'Object' }

/** Elements whose owner, name or type has every word. */
export function matching(elements: Element[], query: string): Element[] {
  const words = query.toLowerCase().split(/\s+/).filter(Boolean)
  return elements.filter(({ owner, name, type }) => {
    const text = `${owner} ${name} ${type}`.toLowerCase()
    return words.every((word) => text.includes(word))
  })
}
