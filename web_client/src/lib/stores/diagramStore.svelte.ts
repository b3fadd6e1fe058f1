/** The state of the diagram: shown robots, programs and Roles, their elements and values, pipes, what is selected, and undo. */
import { robotSocket } from '../api/api'
import { addPipe, orderPipe, pipes as fetchPipes, programs as fetchPrograms, removePipe } from '../api/pipes'
import * as api from '../api/roles'
import type { NewPipe, PipeStatus, ProgramInfo, RoleInfo, RoleRun } from '../api/types'
import { inRosNames, messageWith, type TypeDef, valueAt } from '../diagram/fields'
import { History, type Step } from '../diagram/history'
import type { Point } from '../diagram/layout'
import * as model from '../diagram/model'
import type { Element, Line, Place, RobotParts } from '../diagram/model'
import { bindingOf, type Document, mappingOf, partsOf, type RoleParts, type Statement, withoutStatement, withStatement } from '../diagram/roleDocument'
import { Link } from '../ros/robotLink'
import { fullType, isHeavy } from '../ros/topics'
import { app } from './appStore.svelte.ts'
import { watch } from './liveUpdates.svelte.ts'
import { recall, remember } from './storage'

/** Times between two readings, ms. */
const PIPES_MS = 1000
const LISTS_MS = 5000
const VALUES_MS = 250
/** Robots and Roles that are shown before the user chooses. */
const SHOWN_FIRST = 6
/** Longest time without a message after which a value is marked as old, ms. */
const OLD_MS = 5000

/** Types that one small message shows. */
const PLAIN = /^std_msgs\/msg\/(Bool|String|U?Int(8|16|32|64)|Float(32|64))$/

export type Selection =
  | { what: 'element'; id: string }
  | { what: 'pipe'; name: string; owner: string }
  | { what: 'mapping'; id: string }
  | { what: 'node'; id: string }

interface Reading {
  message: unknown
  /** Of the page's clock. */
  atMs: number
}

interface RoleView extends RoleParts {
  revision: number
}

export class DiagramStore {
  private robots = $state.raw<Record<string, RobotParts>>({})
  private views = $state.raw<Record<string, RoleView>>({})
  private definitions = $state.raw<Record<string, TypeDef[]>>({})
  /** First message of a topic: how long its lists are. */
  private samples = $state.raw<Record<string, unknown>>({})
  private readings = $state.raw<Record<string, Reading>>({})
  private chosen = $state.raw<{ hidden: string[]; shown: string[] }>({ hidden: [], shown: [] })
  private nowMs = $state(performance.now())
  roles = $state.raw<RoleInfo[] | null>(null)
  private programs = $state.raw<ProgramInfo[]>([])
  runs = $state.raw<Record<string, RoleRun>>({})
  pipes = $state.raw<PipeStatus[]>([])
  /** Messages a second of each pipe, by owner and name. */
  rates = $state.raw<Record<string, number>>({})
  opened = $state.raw<ReadonlySet<string>>(new Set())
  /** Nodes that show all their rows. */
  unfolded = $state.raw<ReadonlySet<string>>(new Set())
  moved = $state.raw<Record<string, Point>>({})
  selection = $state.raw<Selection | null>(null)
  failure = $state<string | null>(null)
  busy = $state(false)
  undoLabel = $state<string | null>(null)
  redoLabel = $state<string | null>(null)

  private readonly history = new History(() => {
    this.undoLabel = this.history.undoLabel
    this.redoLabel = this.history.redoLabel
  })
  private readonly links = new Map<string, Link>()
  private readonly subscriptions = new Map<string, () => void>()
  private readonly asked = new Set<string>()
  private readonly counts = new Map<string, { messages: number; atMs: number }>()
  private arrived = new Map<string, Reading>()
  private timers: ReturnType<typeof setInterval>[] = []

  readonly robotNames = $derived((watch.robots ?? []).map(({ name }) => name).sort((a, b) => a.localeCompare(b, undefined, { numeric: true })))
  readonly roleNames = $derived((this.roles ?? []).map(({ name }) => name))
  readonly programNames = $derived(this.programs.map(({ name }) => name))
  readonly nodes = $derived(
    [...this.robotNames.map(model.robotId), ...this.programNames.map(model.programId), ...this.roleNames.map(model.roleId)].filter((id) =>
      this.isShown(id),
    ),
  )
  readonly elements = $derived(this.allElements())
  readonly byId = $derived(new Map(this.elements.map((each) => [each.id, each])))
  readonly lines = $derived<Line[]>([
    ...model.linesOfPipes(this.pipes, new Set(this.elements.map(({ id }) => id))),
    ...model.linesOfMappings(this.elements),
  ])
  /** Topics whose values are shown: key and place. */
  readonly watched = $derived(this.watchedTopics())
  readonly selected = $derived(this.selection?.what === 'element' ? (this.byId.get(this.selection.id) ?? null) : null)
  readonly selectedPipe = $derived.by(() => {
    const selection = this.selection
    return selection?.what === 'pipe' ? (this.pipes.find(({ name, owner }) => name === selection.name && owner === selection.owner) ?? null) : null
  })

  constructor() {
    const name = `diagram:${app.session?.user ?? ''}`
    const kept = recall<{ hidden: string[]; shown: string[]; moved: Record<string, Point> }>(name, { hidden: [], shown: [], moved: {} })
    this.chosen = { hidden: kept.hidden, shown: kept.shown }
    this.moved = kept.moved
  }

  start(): void {
    void this.readPipes()
    void this.readLists()
    this.timers = [
      setInterval(() => void this.readPipes(), PIPES_MS),
      setInterval(() => void this.readLists(), LISTS_MS),
      setInterval(() => this.showArrived(), VALUES_MS),
    ]
  }

  close(): void {
    this.timers.forEach(clearInterval)
    for (const link of this.links.values()) link.close()
  }

  // --- what is shown ------------------------------------------------------------------------------------------

  isShown(node: string): boolean {
    if (this.chosen.hidden.includes(node)) return false
    if (this.chosen.shown.includes(node)) return true
    const kinds = [this.robotNames.map(model.robotId), this.programNames.map(model.programId), this.roleNames.map(model.roleId)]
    return kinds.some((names) => names.slice(0, SHOWN_FIRST).includes(node))
  }

  show(node: string, shown: boolean): void {
    const without = (list: string[]) => list.filter((each) => each !== node)
    this.chosen = shown
      ? { hidden: without(this.chosen.hidden), shown: [...without(this.chosen.shown), node] }
      : { hidden: [...without(this.chosen.hidden), node], shown: without(this.chosen.shown) }
    this.remember()
    if (shown) void this.readLists()
  }

  toggleFields(topic: string): void {
    this.opened = toggled(this.opened, topic)
  }

  toggleRows(node: string): void {
    this.unfolded = toggled(this.unfolded, node)
  }

  robot(node: string): RobotParts | null {
    return this.robots[nameOf(node)] ?? null
  }

  isOnline(robot: string): boolean {
    return watch.robots?.some(({ name, state }) => name === robot && state !== 'offline') ?? false
  }

  role(node: string): { info: RoleInfo; view: RoleView | null; run: RoleRun | null } | null {
    const name = nameOf(node)
    const info = this.roles?.find((each) => each.name === name)
    return info === undefined ? null : { info, view: this.views[name] ?? null, run: this.runs[name] ?? null }
  }

  elementsOf(node: string): Element[] {
    return this.elements.filter((each) => each.node === node)
  }

  linesOf(id: string): Line[] {
    return this.lines.filter(({ from, to }) => from === id || to === id)
  }

  /** The newest value of an element; undefined before the first. */
  value({ place }: Pick<Element, 'place'>): { value: unknown; old: boolean } | undefined {
    if (place === null) return undefined
    const reading = this.readings[keyOf(place)]
    return reading === undefined ? undefined : { value: valueAt(reading.message, place.path), old: this.nowMs - reading.atMs > OLD_MS }
  }

  /** Fields of a topic, or arguments and fields of replies of a service or action, whether or not they are shown. */
  fieldsOf(topic: Element): Element[] {
    if (isCalled(topic)) {
      const [request, response] = partTypes(topic).map((type) => this.definitionsOf(topic.owner, type))
      return model.elementsOfCalled(topic, request!, response!)
    }
    const place = topic.place
    if (place === null) return []
    return model.elementsOfTopic(topic, this.definitionsOf(place.robot, place.type), this.samples[keyOf(place)])
  }

  private allElements(): Element[] {
    return this.nodes.flatMap((node) => {
      const name = nameOf(node)
      if (node.startsWith('role:')) {
        const view = this.views[name]
        if (view === undefined) return []
        const typeOf = (robot: string, topic: string) => this.robots[robot]?.topics.find((each) => each.name === topic)?.types[0] ?? ''
        return model.elementsOfRole(name, view, typeOf, (robot, type) => this.definitionsOf(robot, type))
      }
      if (node.startsWith('program:')) return this.programs.filter((each) => each.name === name).flatMap(model.elementsOfProgram)
      const parts = this.robots[name]
      if (parts === undefined) return []
      return model.elementsOfRobot(parts).flatMap((each) => (this.opened.has(each.id) ? [each, ...this.fieldsOf(each)] : [each]))
    })
  }

  private definitionsOf(robot: string, type: string): TypeDef[] {
    return this.definitions[`${robot} ${type}`] ?? []
  }

  private watchedTopics(): Map<string, Place> {
    const found = new Map<string, Place>()
    const connected = new Set(this.lines.flatMap(({ from, to }) => [from, to]))
    for (const each of this.elements) {
      const place = each.place
      if (place === null || place.type === '' || (each.item === null && !each.gives)) continue
      const chosen = this.selection?.what === 'element' && this.selection.id === each.id
      const shown = each.item !== null || each.kind === 'field' || connected.has(each.id) || PLAIN.test(fullType(place.type))
      if (chosen || (shown && !isHeavy(place.type))) found.set(keyOf(place), place)
    }
    return found
  }

  // --- reading ------------------------------------------------------------------------------------------------

  /** Subscribes to what is shown, and asks for definitions of types that are needed. To be called after each change of them. */
  follow(): void {
    const wanted = this.watched
    for (const [key, place] of wanted) {
      if (this.subscriptions.has(key) || !this.isOnline(place.robot)) continue
      const take = (message: unknown) => this.arrived.set(key, { message, atMs: performance.now() })
      const leave = this.link(place.robot).subscribe(place.topic, place.type, take, { throttleMs: VALUES_MS, queueLength: 1 })
      this.subscriptions.set(key, leave)
    }
    for (const [key, leave] of this.subscriptions) {
      if (wanted.has(key)) continue
      leave()
      this.subscriptions.delete(key)
    }
  }

  /** Asks for the definition of each type that an element on the page needs. */
  learn(elements: Element[]): void {
    for (const each of elements) {
      if (isCalled(each) && each.type !== '') for (const type of partTypes(each)) void this.ask(each.owner, type)
      if (each.place !== null && each.place.type !== '') void this.ask(each.place.robot, each.place.type)
    }
  }

  private async ask(robot: string, type: string): Promise<void> {
    const key = `${robot} ${type}`
    if (this.asked.has(key) || !this.isOnline(robot)) return
    const link = this.link(robot)
    if (!link.isOpen) return
    this.asked.add(key)
    try {
      const answer = await link.call<object, { typedefs: TypeDef[] }>('/rosapi/message_details', 'rosapi_msgs/srv/MessageDetails', { type })
      this.definitions = { ...this.definitions, [key]: inRosNames(answer.typedefs) }
    } catch {
      setTimeout(() => this.asked.delete(key), LISTS_MS)
    }
  }

  private link(robot: string): Link {
    const known = this.links.get(robot)
    if (known !== undefined) return known
    const link = new Link(robotSocket(robot, location), {
      state: () => undefined,
      // Topics that the user may not see have no value here.
      received: () => undefined,
    })
    this.links.set(robot, link)
    link.connect()
    return link
  }

  private showArrived(): void {
    this.nowMs = performance.now()
    if (this.nodes.length > 0) this.learn(this.elements.filter(({ id, item }) => this.opened.has(id) || item !== null))
    const selected = this.selected
    if (selected !== null) this.learn([selected, ...(selected.gives ? this.candidates(selected) : this.sources(selected))])
    if (this.arrived.size === 0) return
    const readings = { ...this.readings }
    const samples: Record<string, unknown> = {}
    for (const [key, reading] of this.arrived) {
      readings[key] = reading
      if (!(key in this.samples)) samples[key] = reading.message
    }
    this.arrived = new Map()
    this.readings = readings
    if (Object.keys(samples).length > 0) this.samples = { ...this.samples, ...samples }
  }

  async readPipes(): Promise<void> {
    try {
      const found = await fetchPipes()
      this.rates = this.ratesOf(found)
      this.pipes = found
      this.failure = null
    } catch (error) {
      this.failure = words(error)
    }
    const shown = this.roleNames.filter((name) => this.isShown(model.roleId(name)))
    const runs = await Promise.all(shown.map((name) => api.roleRun(name).catch(() => null)))
    this.runs = Object.fromEntries(shown.flatMap((name, index) => (runs[index] == null ? [] : [[name, runs[index]]])))
  }

  private ratesOf(found: PipeStatus[]): Record<string, number> {
    const now = performance.now()
    return Object.fromEntries(
      found.map(({ owner, name, messages }) => {
        const key = `${owner} ${name}`
        const before = this.counts.get(key)
        this.counts.set(key, { messages, atMs: now })
        const rate = before === undefined ? 0 : ((messages - before.messages) * 1000) / (now - before.atMs)
        return [key, Math.max(0, rate)]
      }),
    )
  }

  async readLists(): Promise<void> {
    try {
      ;[this.roles, this.programs] = await Promise.all([api.roles(), fetchPrograms()])
    } catch (error) {
      this.failure = words(error)
    }
    await Promise.all([...this.nodes.map((node) => this.readNode(node).catch(() => undefined))])
  }

  private async readNode(node: string): Promise<void> {
    const name = nameOf(node)
    if (node.startsWith('program:')) return
    if (node.startsWith('robot:')) {
      const [{ online, topics }, services, actions] = await Promise.all([api.topicsOf(name), api.servicesOf(name), api.actionsOf(name)])
      const known = topics.map((topic) => ({ ...topic, types: topic.types.map(fullType) }))
      const parts = { name, online, topics: known, services, actions }
      // The same lists leave the page as it is.
      if (JSON.stringify(parts) !== JSON.stringify(this.robots[name])) this.robots = { ...this.robots, [name]: parts }
      return
    }
    const revision = this.roles?.find((role) => role.name === name)?.revision ?? 0
    if (this.views[name]?.revision === revision) return
    const { document } = await api.roleDocument(name)
    this.views = { ...this.views, [name]: { ...partsOf(document), revision } }
    // Values and types of robots that the diagram does not show.
    const robots = new Set(this.views[name]?.items.flatMap(({ resources }) => resources.map((text) => /robots\/([^/#]+)\//.exec(text)?.[1] ?? '')))
    for (const robot of robots) {
      const id = model.robotId(decodeURIComponent(robot))
      if (robot !== '' && !this.nodes.includes(id)) await this.readNode(id).catch(() => undefined)
    }
  }

  // --- changes ------------------------------------------------------------------------------------------------

  /** Elements to which a line from this one may lead, also fields that are not shown. */
  candidates(from: Element): Element[] {
    return this.elements
      .flatMap((each) => (model.opens(each) && !this.opened.has(each.id) && each.takes ? [each, ...this.fieldsOf(each)] : [each]))
      .filter((each) => each.takes && each.id !== from.id)
  }

  /** Elements from which a line to this one may come, also fields that are not shown. */
  sources(to: Element): Element[] {
    return this.elements
      .flatMap((each) => (model.opens(each) && !this.opened.has(each.id) && each.gives ? [each, ...this.fieldsOf(each)] : [each]))
      .filter((each) => each.gives && each.id !== to.id)
  }

  /** Connects two elements. Returns whether it was done; if not, the reason is shown. */
  async connect(from: Element, to: Element): Promise<boolean> {
    const link = model.linkOf(from, to)
    if (typeof link === 'string') return this.refuse(link)
    const label = `connect ${from.owner} ${from.name} to ${to.owner} ${to.name}`
    if (link.makes === 'mapping') return this.take(this.statementStep(label, link.role, mappingOf(link.from, link.to), true))
    if (link.makes === 'binding') return this.take(this.statementStep(label, link.role, bindingOf(link.iri, link.resource), true))
    const change = model.pipeFor(link, this.ownPipes)
    if (typeof change === 'string') return this.refuse(change)
    for (const each of [from, to]) {
      if (model.isPart(each) && !this.opened.has(model.wholeId(each))) this.toggleFields(model.wholeId(each))
    }
    const done = await this.take(this.pipeStep(label, change.before, change.after))
    const name = change.after?.name
    const made = this.ownPipes.find((each) => each.name === name)
    if (done && made !== undefined) this.selection = { what: 'pipe', name: made.name, owner: made.owner }
    return done
  }

  removePipe(pipe: PipeStatus): Promise<boolean> {
    return this.take(this.pipeStep(`remove the pipe ${pipe.name}`, model.settingsOf(pipe), null))
  }

  changePipe(pipe: PipeStatus, change: Partial<NewPipe>): Promise<boolean> {
    const before = model.settingsOf(pipe)
    return this.take(this.pipeStep(`change the pipe ${pipe.name}`, before, { ...before, ...change }))
  }

  removeMapping({ mapping }: Line): Promise<boolean> {
    if (mapping === null) return Promise.resolve(false)
    const { role, from, to } = mapping
    return this.take(this.statementStep('remove a mapping', role, mappingOf(from, to), false))
  }

  removeBinding(role: string, iri: string, resource: string): Promise<boolean> {
    return this.take(this.statementStep('remove what an element stands for', role, bindingOf(iri, resource), false))
  }

  /** Loads files with Roles, one after the other. */
  async load(files: Iterable<File>): Promise<void> {
    for (const file of files) {
      const text = await file.text()
      const media = api.mediaOf(file.name, text)
      let names: string[] = []
      const step: Step = {
        label: `load ${file.name}`,
        do: async () => {
          const loaded = await api.loadRoles(media, text)
          names = loaded.names
          for (const note of loaded.notes.slice(0, 3)) app.notify('info', note)
        },
        undo: async () => {
          for (const name of names) await api.removeRole(name)
        },
      }
      if (await this.take(step)) {
        for (const name of names) this.show(model.roleId(name), true)
        this.selection = { what: 'node', id: model.roleId(names[0] ?? '') }
        app.notify('info', `Loaded ${names.join(', ')}.`)
      }
    }
  }

  async removeRole(name: string): Promise<boolean> {
    let document: Document = []
    const step: Step = {
      label: `remove the Role ${name}`,
      do: async () => {
        document = (await api.roleDocument(name)).document
        await api.removeRole(name)
      },
      undo: () => api.putRole(name, document, ''),
    }
    const done = await this.take(step)
    if (done) this.selection = null
    return done
  }

  /** Notes that the user has moved nodes. */
  move(moved: Record<string, Point>): void {
    const before = this.moved
    const after = { ...before, ...moved }
    const become = (places: Record<string, Point>) => () => {
      this.moved = places
      this.remember()
      return Promise.resolve()
    }
    void become(after)()
    this.history.note({ label: 'move', do: become(after), undo: become(before) })
  }

  undo(): Promise<boolean> {
    return this.work(this.history.undo())
  }

  redo(): Promise<boolean> {
    return this.work(this.history.redo())
  }

  // --- commands -----------------------------------------------------------------------------------------------

  orderRole(name: string, action: 'start' | 'stop'): Promise<boolean> {
    return this.work(
      api.orderRole(name, action).then(({ parts }) => {
        for (const { element, why } of parts.filter(({ state, why }) => state === 'failed' && why !== '').slice(0, 3)) app.notify('warning', `${element}: ${why}`)
      }),
    )
  }

  orderPipe(name: string, action: 'start' | 'stop'): Promise<boolean> {
    return this.work(orderPipe(name, action))
  }

  /** Commands that an element takes (docs/guides/roles.md). */
  commandsOf(element: Element): ReadonlySet<string> {
    if (element.kind === 'service') return new Set(['call'])
    if (element.place === null && element.item === null) return new Set()
    if (element.item === null) return new Set(element.takes && element.place?.path.includes('[') !== true ? ['set'] : [])
    const mapped = this.elementsOf(element.node).filter(
      ({ item }) => item !== null && (element.item!.mappings.includes(item.iri) || item.mappings.includes(element.item!.iri)),
    )
    const bound = element.bound.length > 0 ? element.bound : mapped.flatMap((each) => each.bound)
    const found = new Set<string>()
    for (const { kind, name } of bound) {
      const part = kind === 'programs' ? (/\/(ports|functions)\//.exec(name)?.[1] ?? kind) : kind
      if (['topics', 'params', 'ports'].includes(part)) found.add('set')
      if (['services', 'functions'].includes(part)) found.add('call')
      if (['modules', 'pipes', 'programs'].includes(part)) found.add('start').add('stop')
    }
    return found
  }

  /** Sets the value of an element. */
  set(element: Element, value: unknown): Promise<boolean> {
    const { item, place, owner } = element
    if (item !== null) return this.work(api.setElement(owner, item.name, value), `${element.name} is set.`)
    if (place === null) return Promise.resolve(false)
    const message = messageWith(place.path, value)
    if (message === null) return Promise.resolve(this.refuse(`${place.path} is a value in a list, which can’t be set alone. Set the whole message.`))
    return this.work(api.publish(place.robot, place.topic, place.type, message), `${element.name} is set.`)
  }

  /** Calls, starts or stops. Returns the answer in words, or null if it failed. */
  async order(element: Element, command: 'call' | 'start' | 'stop', args: unknown): Promise<string | null> {
    let answer: unknown = null
    const request =
      element.item !== null
        ? api.orderElement(element.owner, element.item.name, command, args).then((done) => (answer = done.values ?? done.state))
        : api.call(element.owner, element.name, args).then((done) => (answer = (done as { values?: unknown }).values))
    const done = await this.work(request)
    if (!done) return null
    return answer === null || answer === undefined || answer === '' ? 'Done.' : typeof answer === 'string' ? answer : JSON.stringify(answer)
  }

  get ownPipes(): PipeStatus[] {
    const names = [app.session?.user, `${app.session?.user}@${app.session?.realm}`]
    return this.pipes.filter(({ owner }) => names.includes(owner))
  }

  private pipeStep(label: string, before: NewPipe | null, after: NewPipe | null): Step {
    const swap = (old: NewPipe | null, next: NewPipe | null) => async () => {
      if (old !== null) await removePipe(old.name)
      try {
        if (next !== null) await addPipe(next)
      } catch (error) {
        if (old !== null) await addPipe(old).catch(() => undefined)
        throw error
      }
    }
    return { label, do: swap(before, after), undo: swap(after, before) }
  }

  private statementStep(label: string, role: string, statement: Statement, adds: boolean): Step {
    const write = (adding: boolean) => async () => {
      const { document, etag } = await api.roleDocument(role)
      await api.putRole(role, (adding ? withStatement : withoutStatement)(document, statement), etag)
    }
    return { label, do: write(adds), undo: write(!adds) }
  }

  private take(step: Step): Promise<boolean> {
    return this.work(this.history.take(step))
  }

  private async work(work: Promise<unknown>, done = ''): Promise<boolean> {
    this.busy = true
    try {
      await work
    } catch (error) {
      return this.refuse(words(error))
    } finally {
      this.busy = false
    }
    if (done !== '') app.notify('info', done)
    await Promise.all([this.readPipes(), this.readLists()])
    return true
  }

  private refuse(why: string): false {
    app.notify('warning', why)
    return false
  }

  private remember(): void {
    remember(`diagram:${app.session?.user ?? ''}`, { ...this.chosen, moved: this.moved })
  }
}

/** Types of the requests and replies of a service, or of the goals and results of an action. */
function partTypes({ kind, type }: Element): [string, string] {
  return kind === 'action' ? [`${type}_Goal`, `${type}_Result`] : [`${type}_Request`, `${type}_Response`]
}

function isCalled({ kind }: Element): boolean {
  return kind === 'service' || kind === 'action'
}

/** The name of a robot, program or Role by the id of its node. */
export function nameOf(node: string): string {
  return node.slice(node.indexOf(':') + 1)
}

function keyOf({ robot, topic }: Place): string {
  return `${robot} ${topic}`
}

function toggled(set: ReadonlySet<string>, id: string): ReadonlySet<string> {
  const next = new Set(set)
  if (!next.delete(id)) next.add(id)
  return next
}

function words(error: unknown): string {
  return error instanceof Error ? error.message : String(error)
}
