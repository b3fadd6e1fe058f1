/** Documents of Roles as JSON-LD, as the relay writes them: expanded, one object for each resource. */

const FIERRO = 'fierro:'
/** The namespace as the FIERRo paper's files have it: types and names follow a hash, properties may follow at once. */
const PAPER = 'http://www-robot.mes.titech.ac.jp/fierro'
const TYPE = 'http://www.w3.org/1999/02/22-rdf-syntax-ns#type'
const RESOURCE = 'switchboard:resource'
const MAPPING = 'fierro:mapping'

export type Document = Resource[]
type Resource = { '@id': string } & Record<string, unknown>

export type Lane = 'subject' | 'action' | 'directObject'
export const LANES: Lane[] = ['subject', 'action', 'directObject']

/** A named element of a Role. */
export interface Item {
  iri: string
  /** In `fierro:`, or the IRI. */
  name: string
  /** Such as `field`; by the property that leads to it where it has none of its own. */
  type: string
  lane: Lane | null
  resources: string[]
  /** IRIs of elements that it is mapped to. */
  mappings: string[]
}

export interface RoleParts {
  /** Names of subject, action and object. */
  parts: Record<Lane, string>
  items: Item[]
}

export function nameOf(iri: string): string {
  return afterStart(iri, FIERRO, `${PAPER}#`) ?? iri
}

/** The word of a type or property, in each of its spellings; null if it is of another vocabulary. */
function wordOf(iri: string): string | null {
  return afterStart(iri, FIERRO, `${PAPER}#`, PAPER)
}

function afterStart(iri: string, ...starts: string[]): string | null {
  const start = starts.find((each) => iri.startsWith(each))
  return start === undefined ? null : iri.slice(start.length)
}

/** The elements of a Role, in the order of its parts. */
export function partsOf(document: Document): RoleParts {
  const resources = new Map(document.map((each) => [each['@id'], each]))
  const types = new Map<string, string>()
  for (const each of document) {
    for (const [property, iris] of properties(each)) {
      if (property !== 'mapping') for (const iri of iris) if (!types.has(iri)) types.set(iri, property)
    }
  }
  for (const each of document) {
    const own = typesOf(each)[0]
    if (own !== undefined) types.set(each['@id'], own)
  }
  const role = document.find((each) => typesOf(each).includes('role'))
  const parts = { subject: '', action: '', directObject: '' }
  const heads = new Map<string, Lane>()
  for (const lane of LANES) {
    const head = valuesOf(role, lane)[0]
    if (head === undefined) continue
    parts[lane] = nameOf(head)
    heads.set(head, lane)
  }
  const lanes = new Map<string, Lane>()
  for (const [head, lane] of heads) {
    const waiting = [head]
    for (let iri = waiting.shift(); iri !== undefined; iri = waiting.shift()) {
      const inner = resources.get(iri)
      for (const [property, iris] of inner === undefined ? [] : properties(inner)) {
        if (property === 'mapping') continue
        for (const next of iris) {
          if (heads.has(next) || lanes.has(next)) continue
          lanes.set(next, lane)
          waiting.push(next)
        }
      }
    }
  }
  const mapped = document.flatMap((each) => valuesOf(each, 'mapping'))
  const iris = new Set([...lanes.keys(), ...document.map((each) => each['@id']), ...mapped])
  const items = [...iris]
    .filter((iri) => !heads.has(iri) && iri !== role?.['@id'] && !iri.startsWith('_:'))
    .map((iri) => ({
      iri,
      name: nameOf(iri),
      type: types.get(iri) ?? 'element',
      lane: lanes.get(iri) ?? null,
      resources: textsOf(resources.get(iri)?.[RESOURCE]),
      mappings: valuesOf(resources.get(iri), 'mapping'),
    }))
  return { parts, items }
}

/** The document with a statement more, or the same document if it has it. */
export function withStatement(document: Document, statement: Statement): Document {
  const [subject, property, value] = statement
  const found = document.find((each) => each['@id'] === subject) ?? { '@id': subject }
  if (spellings(found, property).some((each) => listOf(found[each]).some((other) => same(other, value)))) return document
  const spelt = property === MAPPING && isPaper(document) ? `${PAPER}#mapping` : property
  const changed = { ...found, [spelt]: [...listOf(found[spelt]), value] }
  return [...document.filter((each) => each['@id'] !== subject), changed]
}

export function withoutStatement(document: Document, statement: Statement): Document {
  const [subject, property, value] = statement
  return document
    .map((each) => {
      if (each['@id'] !== subject) return each
      const concerned = spellings(each, property)
      const left = Object.entries(each).map(([key, values]): [string, unknown] =>
        concerned.includes(key) ? [key, listOf(values).filter((other) => !same(other, value))] : [key, values],
      )
      return Object.fromEntries(left.filter(([key, values]) => !concerned.includes(key) || listOf(values).length > 0)) as Resource
    })
    .filter((each) => Object.keys(each).length > 1)
}

/** Subject, property and value in JSON-LD. */
export type Statement = [string, string, { '@id': string } | { '@value': string }]

export const mappingOf = (from: string, to: string): Statement => [from, MAPPING, { '@id': to }]
export const bindingOf = (iri: string, resource: string): Statement => [iri, RESOURCE, { '@value': resource }]

/** A resource that an element is bound to (docs/guides/roles.md). */
export interface Bound {
  text: string
  /** Empty for a pipe or program. */
  robot: string
  kind: string
  name: string
  /** Field as pipes write it; empty for the whole. */
  path: string
}

/** The address of a resource in its parts, or null. */
export function boundTo(text: string): Bound | null {
  const found = /^(?:\w+:)?\/?(?:api\/v1\/)?(?:robots\/([^/#]+)\/)?(topics|services|actions|params|modules|pipes|programs)\/([^#]+)(?:#(\/.*))?$/.exec(text)
  if (found === null) return null
  try {
    const [robot, kind, name, pointer] = [decode(found[1]), found[2]!, decode(found[3]), decode(found[4])]
    const full = kind === 'topics' || kind === 'services' || kind === 'actions' ? name.replace(/^\/*/, '/') : name
    return { text, robot, kind, name: full, path: pathOf(pointer) }
  } catch {
    return null
  }
}

/** The address of a topic or service, or of a field of it. */
export function addressOf(robot: string, name: string, path: string, kind: 'topics' | 'services' | 'actions' = 'topics'): string {
  const pointer = path === '' ? '' : `#/${path.replaceAll(/\[(\d+)\]/g, '.$1').split('.').join('/')}`
  return `robots/${encodeURIComponent(robot)}/${kind}/${name.replace(/^\//, '')}${pointer}`
}

function pathOf(pointer: string): string {
  return pointer
    .split('/')
    .slice(1)
    .map((step) => step.replaceAll('~1', '/').replaceAll('~0', '~'))
    .reduce((path, step) => (/^\d+$/.test(step) ? `${path}[${step}]` : path === '' ? step : `${path}.${step}`), '')
}

function decode(text: string | undefined): string {
  return decodeURIComponent(text ?? '')
}

function properties(resource: Resource): [string, string[]][] {
  return Object.entries(resource).flatMap(([property, value]) => {
    const word = wordOf(property)
    return word === null ? [] : [[word, idsOf(value)]]
  })
}

/** The types of a resource that are words of Roles. */
function typesOf(resource: Resource): string[] {
  return idsOf(resource[TYPE]).flatMap((iri) => wordOf(iri) ?? [])
}

function valuesOf(resource: Resource | undefined, property: string): string[] {
  return resource === undefined ? [] : properties(resource).flatMap(([word, iris]) => (word === property ? iris : []))
}

/** The keys of a resource that mean a property. */
function spellings(resource: Resource, property: string): string[] {
  const word = wordOf(property)
  return Object.keys(resource).filter((key) => key === property || (word !== null && wordOf(key) === word))
}

function isPaper(document: Document): boolean {
  return document.some((each) => Object.keys(each).some((key) => key.startsWith(PAPER)))
}

function listOf(value: unknown): unknown[] {
  return Array.isArray(value) ? value : []
}

function idsOf(value: unknown): string[] {
  return listOf(value).flatMap((each) => (isObject(each) && typeof each['@id'] === 'string' ? [each['@id']] : []))
}

function textsOf(value: unknown): string[] {
  return listOf(value).flatMap((each) => (isObject(each) && typeof each['@value'] === 'string' ? [each['@value']] : []))
}

function same(one: unknown, other: Statement[2]): boolean {
  if (!isObject(one)) return false
  return '@id' in other ? one['@id'] === other['@id'] : one['@value'] === other['@value']
}

function isObject(value: unknown): value is Record<string, unknown> {
  return typeof value === 'object' && value !== null
}
