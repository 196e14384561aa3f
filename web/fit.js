// Medians, least squares, and the ball that a surface looks like.

export function median(values) {
  const sorted = Float64Array.from(values).sort();
  return sorted[(sorted.length - 1) >> 1];
}

/** Weighted least squares: of `terms` (n rows) the combinations that come nearest to each of `targets` (n values each). */
export function leastSquares(terms, targets, weight = null) {
  const size = terms[0].length, rows = terms[0].map(() => new Float64Array(size + targets.length));
  terms.forEach((term, n) => {
    const all = [...term, ...targets.map((values) => values[n])], share = weight ? weight[n] : 1;
    for (let k = 0; share && k < size; k++) {
      for (let j = 0; j < all.length; j++) rows[k][j] += share * term[k] * all[j];
    }
  });
  rows.forEach((row, k) => { // Gauss and Jordan, without pivots: the matrix is positive
    row[k] += 1e-9;
    for (const other of rows) {
      const factor = other === row ? 0 : other[k] / row[k];
      for (let j = k; factor && j < row.length; j++) other[j] -= factor * row[j];
    }
  });
  return targets.map((_, c) => rows.map((row, k) => row[size + c] / row[k]));
}

/** Diameter, mm, of the sphere that fits the upper half of a contact; null where nothing touches. */
export function ballOf({ depth, contact }, { width, pitch }) {
  const most = depth.reduce((a, b) => Math.max(a, b), 0), terms = [], squares = [];
  depth.forEach((z, k) => {
    if (!contact[k] || z < 0.5 * most) return;
    const x = (k % width) * pitch, y = Math.floor(k / width) * pitch;
    terms.push([2 * x, 2 * y, 2 * z, 1]), squares.push(x * x + y * y + z * z);
  });
  if (terms.length < 30) return null;
  const [[x, y, z, rest]] = leastSquares(terms, [squares]);
  return 2 * Math.sqrt(Math.max(0, rest + x * x + y * y + z * z));
}
