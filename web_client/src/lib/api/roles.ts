/** Roles over HTTP, without user interface. */
import { moment } from './api'
import { ask, send } from './request'
import type { Document } from '../diagram/roleDocument'
import type { ElementDone, ElementValue, RoleInfo, RoleRun } from './types'

const ROLE = '/api/v1/roles/{name}'
const JSON_LD = 'application/ld+json'
const FRESHNESS = 'switchboard-freshness'

/** Roles shown in a list. */
const MOST_ROLES = 1000

/** Forms of a document, by the ending of its file. */
export const FORMS = {
  rdf: { media: 'application/rdf+xml', words: 'RDF/XML' },
  ttl: { media: 'text/turtle', words: 'Turtle' },
  jsonld: { media: JSON_LD, words: 'JSON-LD' },
} as const
export type Form = keyof typeof FORMS

/** Media type of a file by its name, or by how it begins. */
export function mediaOf(name: string, text: string): string {
  const ending = name.toLowerCase().split('.').at(-1) ?? ''
  if (ending in FORMS) return FORMS[ending as Form].media
  const start = text.replace(/^\ufeff/, '').trimStart()
  if (ending === 'xml' || ending === 'owl' || start.startsWith('<?xml') || start.startsWith('<rdf:')) return FORMS.rdf.media
  return start.startsWith('{') || start.startsWith('[') ? FORMS.jsonld.media : FORMS.ttl.media
}

export async function roles(): Promise<RoleInfo[]> {
  return (await ask('get', '/api/v1/roles', { query: { limit: MOST_ROLES } })).roles
}

export interface StoredDocument {
  document: Document
  /** For `If-Match`. */
  etag: string
}

export async function roleDocument(role: string): Promise<StoredDocument> {
  const answer = await send('get', ROLE, { names: { name: role }, headers: { Accept: JSON_LD } })
  return { document: (await answer.json()) as Document, etag: answer.headers.get('ETag') ?? '' }
}

/** A document as text, for a file. */
export async function roleText(role: string, form: Form): Promise<string> {
  const answer = await send('get', ROLE, { names: { name: role }, headers: { Accept: FORMS[form].media } })
  return answer.text()
}

/** Stores a document.
 *
 * @param etag of the document that it replaces; empty for a new Role
 */
export async function putRole(role: string, document: Document, etag: string): Promise<void> {
  const match: Record<string, string> = etag === '' ? {} : { 'If-Match': etag }
  await send('put', ROLE, { names: { name: role }, body: { media: JSON_LD, text: JSON.stringify(document) }, headers: match })
}

/** Adds the Roles of a document. Returns their names, and sentences about unusual statements. */
export async function loadRoles(media: string, text: string): Promise<{ names: string[]; notes: string[] }> {
  const { roles } = await ask('post', '/api/v1/roles', { body: { media, text } })
  return { names: roles.map(({ role }) => role.name), notes: roles.flatMap(({ notes }) => notes) }
}

export async function removeRole(role: string): Promise<void> {
  await send('delete', ROLE, { names: { name: role } })
}

export async function roleRun(role: string): Promise<RoleRun> {
  return (await ask('get', '/api/v1/roles/{role}/run', { names: { role } })) as RoleRun
}

export async function orderRole(role: string, action: 'start' | 'stop'): Promise<RoleRun> {
  return (await ask('post', '/api/v1/roles/{role}/run/{action}', { names: { role, action } })) as RoleRun
}

export function elementValue(role: string, element: string): Promise<ElementValue> {
  return ask('get', '/api/v1/roles/{role}/elements/{element}', { names: { role, element } })
}

export async function setElement(role: string, element: string, value: unknown): Promise<ElementDone> {
  const headers = { [FRESHNESS]: await moment() }
  return ask('put', '/api/v1/roles/{role}/elements/{element}', { names: { role, element }, body: { value }, headers })
}

/** @param args of a call */
export async function orderElement(role: string, element: string, command: 'call' | 'start' | 'stop', args: unknown = {}): Promise<ElementDone> {
  const headers = { [FRESHNESS]: await moment() }
  const body = command === 'call' ? { args } : {}
  return ask('post', '/api/v1/roles/{role}/elements/{element}/{command}', { names: { role, element, command }, body, headers })
}

// --- elements of robots ---------------------------------------------------------------------------------------

export async function publish(robot: string, topic: string, type: string, value: unknown): Promise<void> {
  const headers = { [FRESHNESS]: await moment() }
  await send('put', '/api/v1/robots/{robot}/topics/{name}', { names: { robot, name: topic }, body: { value, type }, headers })
}

export async function call(robot: string, service: string, args: unknown): Promise<unknown> {
  const headers = { [FRESHNESS]: await moment() }
  const names = { robot, name: service.replace(/^\//, '') }
  return ask('post', '/api/v1/robots/{robot}/services/{name}', { names, body: { args }, headers })
}

export async function topicsOf(robot: string): Promise<{ online: boolean; topics: Topic[] }> {
  const { online, topics } = await ask('get', '/api/v1/robots/{robot}/topics', { names: { robot }, query: { limit: 1000 } })
  return {
    online,
    topics: topics.map(({ publishers = [], subscribers = [], ...each }) => ({ ...each, publishers, subscribers })),
  }
}

export async function servicesOf(robot: string): Promise<{ name: string; types: string[]; moves: boolean }[]> {
  return (await ask('get', '/api/v1/robots/{robot}/services', { names: { robot }, query: { limit: 1000 } })).services
}

export async function actionsOf(robot: string): Promise<{ name: string; types: string[]; moves: boolean }[]> {
  return (await ask('get', '/api/v1/robots/{robot}/actions', { names: { robot }, query: { limit: 1000 } })).actions
}

interface Topic {
  name: string
  types: string[]
  publishers: string[]
  subscribers: string[]
  moves: boolean
}
