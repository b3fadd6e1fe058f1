import { describe, expect, it } from 'vitest'
import {
  administrators,
  alike,
  byRobot,
  choices,
  dated,
  type Directory,
  enrolCommand,
  goodFor,
  membersOf,
  patternsOf,
  rightWords,
  wanted,
  wantedRights,
  why,
  without,
} from './administration'
import { Refusal } from './request'
import type { RealmRight, RealmUser } from './types'

const user = (name: string, more: Partial<RealmUser> = {}): RealmUser => ({
  user: name,
  admin: false,
  disabled: false,
  password: true,
  guest: false,
  groups: [],
  ...more,
})

const right = (robot: string, holder: string, more: Partial<RealmRight> = {}): RealmRight => ({
  robot,
  holder,
  level: 'viewer',
  allow: [],
  deny: [],
  ...more,
})

const DIRECTORY: Directory = {
  users: [user('ann'), user('joann'), user('luigi'), user('root', { admin: true }), user('gone', { admin: true, disabled: true })],
  groups: [{ group: 'crew', members: ['ann', 'luigi'] }],
}

describe('a filter by name', () => {
  it.each([
    ['', ''],
    ['  ', ''],
    ['Rov', '*rov*'],
    ['rover-?', 'rover-?'],
    ['[ab]*', '[ab]*'],
  ])('finds what is typed anywhere in a name, unless it has wildcards: %o', (typed, pattern) => {
    expect(wanted(typed)).toBe(pattern)
  })

  it.each([
    [{}, {}],
    [{ robot: 'rov' }, { name: '*rov*/*' }],
    [{ robot: 'rover', exact: true }, { robot: 'rover' }],
    [{ who: 'Ann' }, { user: 'ann' }],
    [{ who: 'an' }, { name: '*/*an*' }],
    [{ who: '@crew' }, { name: '*/@crew*' }],
    [{ robot: 'rov', who: 'ann' }, { user: 'ann', name: '*rov*/*' }],
    [{ robot: 'rover', exact: true, who: '@cr' }, { robot: 'rover', name: '*/@cr*' }],
  ])('of rights means all of somebody who is known, also by groups: %o', (filter, asked) => {
    expect(wantedRights({ robot: '', exact: false, who: '', ...filter }, DIRECTORY)).toEqual(asked)
  })
})

describe('rights', () => {
  it('stand by robot, those that go furthest first', () => {
    const list = [right('a', 'luigi'), right('a', 'ann', { level: 'owner' }), right('a', '@crew'), right('b', 'ann')]
    expect(byRobot(list).map(({ robot, rights }) => [robot, rights.map(({ holder }) => holder)])).toEqual([
      ['a', ['ann', '@crew', 'luigi']],
      ['b', ['ann']],
    ])
  })

  it('leave robots over on which there is none', () => {
    const robots = ['a', 'b', 'c'].map((robot) => ({ robot, description: '', keys: 0, guest: false }))
    expect(without(robots, [right('b', 'ann')])).toEqual(['a', 'c'])
  })

  it('are told apart by what they let their holder do', () => {
    const one = right('a', 'ann', { allow: ['call:/reset'] })
    expect(alike(one, right('b', 'luigi', { allow: ['call:/reset'] }))).toBe(true)
    expect(alike(one, right('a', 'ann', { deny: ['call:/reset'] }))).toBe(false)
    expect(rightWords(one)).toBe('viewer; call:/reset allowed')
    expect(rightWords(right('a', 'ann', { level: 'owner', deny: ['a:/b', 'c:/d'] }))).toBe('owner; a:/b, c:/d denied')
  })

  it('take patterns one a line, each once', () => {
    expect(patternsOf(' call:/reset \n\n*:/arm/*\ncall:/reset')).toEqual(['call:/reset', '*:/arm/*'])
    expect(patternsOf('\n ')).toEqual([])
  })
})

describe('who there is to choose from', () => {
  const named = (typed: string) => choices(DIRECTORY, typed).map(({ holder }) => holder)

  it('is who has what is typed in his name, those first that begin with it', () => {
    expect(named('ann')).toEqual(['ann', 'joann'])
    expect(named('CR')).toEqual(['@crew'])
    expect(named('@')).toEqual(['@crew'])
    expect(named('nobody')).toEqual([])
  })

  it('is told with what he is', () => {
    expect(choices(DIRECTORY, 'crew')[0]?.words).toBe('group, 2 members')
    expect(choices(DIRECTORY, 'root')[0]?.words).toBe('administrator')
    expect(choices(DIRECTORY, 'gone')[0]?.words).toBe('disabled')
  })

  it('is not more than fit a list', () => {
    const users = Array.from({ length: 5000 }, (_, i) => user(`u${i}`))
    expect(choices({ users, groups: [] }, 'u')).toHaveLength(50)
  })

  it('knows who is in a group, and who may do everything', () => {
    expect(membersOf(DIRECTORY, '@crew')).toEqual(['ann', 'luigi'])
    expect(membersOf(DIRECTORY, '@nobody')).toBeNull()
    expect(membersOf(DIRECTORY, 'ann')).toBeNull()
    expect(administrators(DIRECTORY)).toEqual(['root'])
  })
})

describe('a code', () => {
  const ANSWER = { robot: 'rover', enrolment_code: 'X', expires_in: 900, robots_port: 9091 }

  it('comes with the command that takes it, and does not stand in it', () => {
    expect(enrolCommand({ ...ANSWER, robot: 'rover' }, 'default', { hostname: 'relay', protocol: 'http:' })).toBe(
      'switchboard-robot enroll --relay relay:9091 --robot rover --code - --state /var/lib/switchboard-robot/state',
    )
    const command = enrolCommand({ ...ANSWER, robot: 'mobile', robots_port: 9191 }, 'lab1', { hostname: 'relay', protocol: 'https:' })
    expect(command).toContain('--relay relay:9191 --tls --robot mobile@lab1 ')
  })

  it('is good for a time', () => {
    const { until } = dated(ANSWER, 1000)
    expect(goodFor(until, 1000)).toBe('15 minutes')
    expect(goodFor(until, 1801)).toBe('2 minutes')
    expect(goodFor(until, 1850)).toBe('less than a minute')
    expect(goodFor(until, 1900)).toBe('')
  })
})

it('tells why something was not done, and how long to wait', () => {
  expect(why(new Refusal(409, 'there is a robot of this name'))).toBe('There is a robot of this name.')
  expect(why(new Refusal(429, 'Too many changes.', 2.3))).toBe('Too many changes. Wait 3 seconds.')
})
