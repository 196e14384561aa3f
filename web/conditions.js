// What a frame was seen under, in words: doubts_of() of torchvts/pipeline/conditions.py.

const UNSEEN_DEG = 5, UNEVEN = 0.06, MOST = 3, LOST_SHARE = 0.5;
const REMEDY = "Another sensor, view or light than the background's, or a contact over all of the skin? Take the background again.";
const percent = (share) => `${Math.round(100 * share)} %`;

/** { text, low }: why less may have been seen than is there, or ""; and whether depth is a least one. Of the 22 `conditions` of torchvts.h. */
export function doubtsOf(conditions) {
  const parts = [], uneven = [], unseen = (Math.atan(conditions[21]) * 180) / Math.PI;
  ["R", "G", "B"].forEach((name, c) => {
    const [level, ...slopes] = conditions.subarray(6 * c, 6 * c + 6), lost = conditions[18 + c];
    uneven.push(Math.hypot(...slopes) / Math.max(level, 1e-6));
    if (lost > LOST_SHARE) parts.push(`channel ${name} is black or saturated in ${percent(lost)} of the skin`);
    if (!(level > 1 / MOST && level < MOST)) parts.push(`channel ${name} has ${percent(level)} of its light in the background`);
  });
  const low = unseen > UNSEEN_DEG;
  if (low) parts.push(`slopes below ${unseen.toFixed(0)} degrees are in doubt, and depth may be too low`);
  if (Math.max(...uneven) > UNEVEN) parts.push("the light is not that of the background, nor a smooth change of it");
  return { low, text: parts.length ? `In doubt: ${parts.join("; ")}. ${REMEDY}` : "" };
}
