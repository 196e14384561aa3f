// Viridis, which colour-blind readers can tell apart, as polynomials (Matt Zucker, public domain): 0 to 1 to R, G, B in 0 to 1.

const TERMS = [
  [0.2777273272, 0.0054073445, 0.3340998053],
  [0.1050930431, 1.4046135299, 1.3845901626],
  [-0.3308618287, 0.2148475595, 0.0950951630],
  [-4.6342304984, -5.7991009734, -19.3324409563],
  [6.2282699363, 14.1799333668, 56.6905526007],
  [4.7763849977, -13.7451453771, -65.3530326334],
  [-5.4354558559, 4.6458526122, 26.3124352496],
];

export function colour(share) {
  const t = Math.min(1, Math.max(0, share));
  return [0, 1, 2].map((c) => TERMS.reduceRight((sum, term) => sum * t + term[c], 0));
}

/** 256 colours as bytes R, G, B, A. */
export const COLOURS = Uint8ClampedArray.from(
  Array.from({ length: 256 }, (_, k) => [...colour(k / 255).map((part) => 255 * part), 255]).flat(),
);
