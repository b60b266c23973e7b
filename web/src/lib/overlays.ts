//! Responses that are laid over a page's own, as its address names them: `prd` is the same pair of another surface,
//! `prd/160` one pair whatever the page shows.

export interface OverlayChoice {
  readonly id: string
  /** null: the page's own pair. */
  readonly pair: number | null
}

export const MOST_OVERLAYS = 4

/** Colours and dashes of overlays, in their order: either tells them apart. */
export const OVERLAY_STYLES = [
  { colour: '--cat-1', dash: [7, 3] },
  { colour: '--cat-2', dash: [2, 3] },
  { colour: '--cat-3', dash: [9, 3, 2, 3] },
  { colour: '--cat-5', dash: [14, 4] },
] as const

export function parseOverlays(text: string | null): OverlayChoice[] {
  const names = [...new Set((text ?? '').split(',').filter(Boolean))]
  return names.slice(0, MOST_OVERLAYS).map((name) => {
    const [, id, pair] = /^(.+)\/(\d+)$/.exec(name) ?? ['', name, null]
    return { id, pair: pair === null ? null : Number(pair) }
  })
}

export const formatOverlays = (overlays: readonly OverlayChoice[]) =>
  overlays.map(({ id, pair }) => (pair === null ? id : `${id}/${pair}`)).join(',')
