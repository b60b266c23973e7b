//! The origin of what a page shows, which its headings and every picture that leaves it say if it is not measured. A page
//! names the origins by `provideOrigins`; without that they are the lake's.
import { getContext, setContext } from 'svelte'

type OriginList = () => readonly string[]
const KEY = Symbol('origins')
const MADE_UP = ['simulated', 'computed']

/** Names the origins of the data below the component that calls it. */
export const provideOrigins = (origins: OriginList): void => {
  setContext(KEY, origins)
}

/** Returns the word for the origins around a component; none if all is measured. */
export function useOriginWord(): () => string {
  const origins = getContext<OriginList | undefined>(KEY)
  return () => originWord(origins?.() ?? [])
}

/** The word for some origins: that of all of them, or `partly simulated`. */
export function originWord(origins: readonly string[]): string {
  const madeUp = [...new Set(origins.filter((origin) => MADE_UP.includes(origin)))]
  if (madeUp.length === 0) return ''
  if (origins.some((origin) => !MADE_UP.includes(origin))) return 'partly simulated'
  return madeUp.length === 1 ? madeUp[0] : 'simulated'
}
