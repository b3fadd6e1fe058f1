/** Documents of Roles as JSON-LD, as the relay writes them: expanded, one object for each resource. */

const FIERRO = 'fierro:'
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
  return iri.startsWith(FIERRO) ? iri.slice(FIERRO.length) : iri
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
    const own = idsOf(each[TYPE]).find((iri) => iri.startsWith(FIERRO))
    if (own !== undefined) types.set(each['@id'], nameOf(own))
  }
  const role = document.find((each) => idsOf(each[TYPE]).includes('fierro:role'))
  const parts = { subject: '', action: '', directObject: '' }
  const heads = new Map<string, Lane>()
  for (const lane of LANES) {
    const head = idsOf(role?.[FIERRO + lane])[0]
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
  const mapped = document.flatMap((each) => idsOf(each[MAPPING]))
  const iris = new Set([...lanes.keys(), ...document.map((each) => each['@id']), ...mapped])
  const items = [...iris]
    .filter((iri) => !heads.has(iri) && iri !== role?.['@id'] && !iri.startsWith('_:'))
    .map((iri) => ({
      iri,
      name: nameOf(iri),
      type: types.get(iri) ?? 'element',
      lane: lanes.get(iri) ?? null,
      resources: textsOf(resources.get(iri)?.[RESOURCE]),
      mappings: idsOf(resources.get(iri)?.[MAPPING]),
    }))
  return { parts, items }
}

/** The document with a statement more, or the same document if it has it. */
export function withStatement(document: Document, statement: Statement): Document {
  const [subject, property, value] = statement
  const found = document.find((each) => each['@id'] === subject) ?? { '@id': subject }
  const values = listOf(found[property])
  if (values.some((each) => same(each, value))) return document
  const changed = { ...found, [property]: [...values, value] }
  return [...document.filter((each) => each['@id'] !== subject), changed]
}

export function withoutStatement(document: Document, statement: Statement): Document {
  const [subject, property, value] = statement
  return document
    .map((each) => {
      if (each['@id'] !== subject) return each
      const left = listOf(each[property]).filter((other) => !same(other, value))
      const { [property]: _, ...rest } = each
      return (left.length === 0 ? rest : { ...each, [property]: left }) as Resource
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
  return Object.entries(resource)
    .filter(([property]) => property.startsWith(FIERRO))
    .map(([property, value]) => [nameOf(property), idsOf(value)])
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
