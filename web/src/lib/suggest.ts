//! Names that somebody may have meant.

/** Edits that make one text of another: the distance of Levenshtein. */
function distance(a: string, b: string): number {
  let row = Array.from({ length: b.length + 1 }, (_, j) => j)
  for (let i = 1; i <= a.length; i += 1) {
    const next = [i]
    for (let j = 1; j <= b.length; j += 1)
      next.push(Math.min(next[j - 1] + 1, row[j] + 1, row[j - 1] + Number(a[i - 1] !== b[j - 1])))
    row = next
  }
  return row[b.length]
}

const MOST = 3

/** The names nearest to what was asked for, at most a third of which is edited. */
export function nearestNames(wanted: string, names: readonly string[]): string[] {
  const asked = wanted.toLowerCase()
  return names
    .map((name) => {
      const own = name.toLowerCase()
      return { name, far: own.includes(asked) ? 0 : distance(asked, own) }
    })
    .filter(({ far }) => far <= Math.max(1, asked.length / 3))
    .sort((a, b) => a.far - b.far)
    .slice(0, MOST)
    .map(({ name }) => name)
}
