"""Choose pairs of photos that are likely to overlap, where matching all pairs would take too long.

Pairs are chosen by the order of capture and by SIFT features. Each photo's descriptors become one vector
(VLAD: Jegou et al., CVPR 2010): per visual word the sum of the differences to it, each scaled to unit length.
Photos with similar vectors show the same surfaces. Then the largest few hundred features of each pair, which
survive changes of size best, are matched (preemptive matching: Wu, 3DV 2013); a match is mutual and passes
the ratio test. On 66 photos of a smooth skull the 815 pairs chosen so (20 a photo) hold 0.96 of those that
COLMAP verifies among all 2145; the 700 most similar by VLAD hold 0.74.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

PAIRS = "pairs.txt"  # file in the stage's folder that lists the matched pairs
RELATIVE_POSES = "relative_poses.npz"  # file beside it with the relative poses of each pair
OVERLAP = 10  # neighbours on each side
FAST_EXHAUSTIVE_LIMIT = 25  # photos
EXHAUSTIVE_LIMIT = 200  # photos; 19 900 pairs, about nine minutes on two cores at 3000 features
LARGEST = 400  # features of a photo that are matched; with 300 fewer pairs are right
RATIO = 0.8  # of the angle to the nearest descriptor over that to the second nearest
FARTHEST = 0.7  # radians between two descriptors that match
CHANCE = 5  # matches that may be chance: with fewer, only the best pairs of a photo are kept
KEPT = 4  # number of these best pairs
FAR, FAR_LEAST = 0.5, 20  # share of a photo's pairs that are far, and their smallest number of matches
WORDS = 64  # visual words
SAMPLE = 20_000  # descriptors that the words are learnt from
MAX_DESCRIPTORS = 1500  # descriptors of a photo that are used: the largest features come first in COLMAP
SIMILAR = 16  # photos that each is matched with, unless a plan says otherwise
NEIGHBOURS = 5  # next photos in the order of capture that each is matched with, likewise
# Up to this number of photos every pair is compared (4950 pairs take about 10 s of a core), and adjustments
# are solved directly; above, iteratively: for 200 photos in half of the time.
FEW_PHOTOS = 100
SHORTLIST = 3
_ROWS = 256  # photos compared at a time
_ROUNDS = 12  # of k-means


def vlad_vectors(
    read: Callable[[str], np.ndarray],  # name -> [F, 128] uint8
    names: Sequence[str],
    seed: int = 0,
) -> np.ndarray:  # [N, WORDS * 128] float32, unit length; zero where a photo has no features
    """Compute one vector a photo, with one photo's descriptors in memory at a time."""
    generator = np.random.default_rng(seed)
    share = max(1, SAMPLE // max(len(names), 1))
    sample = []
    for name in names:
        rows = read(name)[:MAX_DESCRIPTORS]
        if len(rows):
            sample.append(unit_descriptors(rows[generator.permutation(len(rows))[:share]]))
    vectors = np.zeros((len(names), WORDS * 128), np.float32)
    if not sample:
        return vectors
    words = _words(np.concatenate(sample), generator)
    for index, name in enumerate(names):
        vectors[index] = _vlad(read(name)[:MAX_DESCRIPTORS], words)
    return vectors


def _words(sample: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Learn visual words by k-means from random rows; a word without descriptors stays where it is."""
    count = min(WORDS, len(sample))
    words = sample[generator.permutation(len(sample))[:count]]
    for _ in range(_ROUNDS):
        nearest = _nearest(sample, words)
        for word in range(count):
            mine = sample[nearest == word]
            if len(mine):
                words[word] = mine.mean(axis=0)
    return words


def _nearest(rows: np.ndarray, words: np.ndarray) -> np.ndarray:
    return np.argmin((words * words).sum(axis=1) - 2 * (rows @ words.T), axis=1)


def _vlad(rows: np.ndarray, words: np.ndarray) -> np.ndarray:
    out = np.zeros((WORDS, 128), np.float32)
    if len(rows):
        units = unit_descriptors(rows)
        nearest = _nearest(units, words)
        for word in np.unique(nearest):
            out[word] = (units[nearest == word] - words[word]).sum(axis=0)
        out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-6)
    flat = out.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-6)


def most_similar(
    vectors: np.ndarray,  # [N, D]
    queries: Sequence[int],  # rows that look for pairs
    among: Sequence[int],  # rows that they may be paired with
    count: int = SIMILAR,
    far: int = 0,
) -> list[tuple[int, int]]:
    """Return (query, other) pairs, the most similar first; equal ones by row.

    Each query gets at most `count`, and `far` more, ever farther from each other, of the more similar half.
    """
    pool = np.array(among, np.intp)
    ranks = np.union1d(np.arange(count), np.geomspace(count, max(count, len(pool) / 2), far).astype(int))
    ranks = ranks[ranks < len(pool)]
    pairs: list[tuple[int, int]] = []
    for start in range(0, len(queries), _ROWS):
        chunk = np.array(queries[start : start + _ROWS], np.intp)
        alike = vectors[chunk] @ vectors[pool].T
        alike[chunk[:, None] == pool[None]] = -np.inf
        best = np.argsort(-alike, axis=1, kind="stable")[:, ranks]
        for row, query in enumerate(chunk):
            pairs += [(int(query), int(pool[k])) for k in best[row] if np.isfinite(alike[row, k])]
    return pairs


def retrieval_pairs(
    read: Callable[[str], np.ndarray],  # name -> [F, 128] uint8, the largest feature first
    names: Sequence[str],  # in the order of capture
    test_names: set[str],
    similar: int = SIMILAR,
    neighbours: int = NEIGHBOURS,
    only: Collection[str] | None = None,
    seed: int = 0,
    jobs: int = 1,
) -> list[tuple[str, str]]:
    """Pair each photo with those that share most features and with the next ones in the order of capture.

    Photos of a separate test set get no next ones. Up to `FEW_PHOTOS` photos every pair is compared; above,
    each photo is compared with `SHORTLIST` times `similar` photos, most of them those with the most similar
    vectors, and some of its pairs are far.

    Args:
        read: returns the descriptors of a photo; called several times a name.
        names: photos in the order of capture.
        test_names: photos of a separate test set.
        similar: largest number of photos that each is matched with.
        neighbours: next photos that each is matched with.
        only: photos that look for pairs; None: all.
        seed: of the visual words.
        jobs: threads.

    Returns:
        Each pair once, in a fixed order; at most `similar` + `neighbours` a photo.
    """
    everyone = list(range(len(names)))
    asking = [i for i in everyone if only is None or names[i] in only]
    walk = [i for i in everyone if names[i] not in test_names]
    pairs = {
        (walk[i], walk[i + s])
        for i in range(len(walk))
        for s in range(1, neighbours + 1)
        if i + s < len(walk) and (only is None or {names[walk[i]], names[walk[i + s]]} & set(only))
    }
    far_share = 0.0
    if len(names) <= FEW_PHOTOS:
        listed = [(a, b) for a in asking for b in everyone if a != b]
    else:
        far_share, near = FAR, (SHORTLIST - 1) * similar
        listed = most_similar(vlad_vectors(read, names, seed), asking, everyone, near, similar)
    pairs |= best_pairs(shared_features(read, names, listed, jobs), dict.fromkeys(asking, similar), far_share)
    return [(names[a], names[b]) for a, b in sorted(pairs)]


def pairs_of_test_set(
    vectors: np.ndarray,  # [N, D]
    names: Sequence[str],
    test_names: set[str],
) -> list[tuple[str, str]]:
    """Pair photos of a separate test set with the most similar photos of the walk and of the test set."""
    walk = [i for i, name in enumerate(names) if name not in test_names]
    tests = [i for i, name in enumerate(names) if name in test_names]
    pairs = {(min(a, b), max(a, b)) for a, b in most_similar(vectors, tests, walk, 2 * SIMILAR)}
    pairs |= {(min(a, b), max(a, b)) for a, b in most_similar(vectors, tests, tests, SIMILAR // 2)}
    return [(names[a], names[b]) for a, b in sorted(pairs)]


def sequential_pairs(names: list[str], test_names: set[str]) -> list[tuple[str, str]]:
    """Pair neighbours in the given order, and photos 2^k further on.

    Photos of a separate test set are not part of the walk: their neighbours by name are other test photos.
    `pairs_of_test_set` finds theirs.

    Args:
        names: photos in the order of capture.
        test_names: photos of a separate test set; may be empty.

    Returns:
        Each pair once, in a fixed order.
    """
    walk = [n for n in names if n not in test_names]
    steps = sorted({*range(1, OVERLAP + 1), *(2**k for k in range(4, 10))})
    return [(walk[i], walk[i + s]) for i in range(len(walk)) for s in steps if i + s < len(walk)]


def shared_features(
    read: Callable[[str], np.ndarray],  # name -> [F, 128] uint8, the largest feature first
    names: Sequence[str],
    pairs: Iterable[tuple[int, int]],
    jobs: int,
) -> dict[tuple[int, int], int]:
    """Count the matches of each pair (a, b) with a < b; the result does not depend on `jobs`."""
    units = [unit_descriptors(read(name)[:LARGEST]) for name in names]
    todo = sorted({(min(a, b), max(a, b)) for a, b in pairs if a != b})
    with ThreadPoolExecutor(jobs) as pool:
        counts = pool.map(lambda pair: _matches(units[pair[0]], units[pair[1]]), todo)
        return dict(zip(todo, counts))


def unit_descriptors(rows: np.ndarray) -> np.ndarray:
    """Scale descriptors [F, 128] to float32 of unit length."""
    values = rows.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)


def _matches(a: np.ndarray, b: np.ndarray) -> int:
    if len(a) < 2 or len(b) < 2:
        return 0
    alike = a @ b.T
    rows = np.arange(len(a))
    nearest = alike.argmax(axis=1)
    mutual = alike.argmax(axis=0)[nearest] == rows
    best = alike[rows, nearest]
    alike[rows, nearest] = -1.0
    first, second = (np.arccos(np.clip(c, -1.0, 1.0)) for c in (best, alike.max(axis=1)))
    return int(np.sum(mutual & (first < RATIO * second) & (first < FARTHEST)))


def best_pairs(
    shared: Mapping[tuple[int, int], int], wanted: Mapping[int, int], far: float = 0.0
) -> set[tuple[int, int]]:
    """Choose the best pairs of each photo, at most `wanted`, and at most `KEPT` that may be chance.

    `far` is the share of pairs that are spread over all that are no chance, instead of the best: in a dense
    capture the best are next to each other, and such a chain of short steps bends.
    """
    matched_with: dict[int, list[tuple[int, int]]] = {}
    for (a, b), count in shared.items():
        matched_with.setdefault(a, []).append((-count, b))
        matched_with.setdefault(b, []).append((-count, a))
    best = set()
    for photo, most in wanted.items():
        ranked = sorted(matched_with.get(photo, []))
        sure = sum(-minus >= FAR_LEAST for minus, _ in ranked)
        near = most - round(far * most)
        if sure > most > near:
            ranks = np.linspace(near, sure - 1, most - near).astype(int)
            ranked = [*ranked[:near], *(ranked[k] for k in ranks)]
        for rank, (minus, other) in enumerate(ranked[:most]):
            if -minus >= CHANCE or rank < KEPT:
                best.add((min(photo, other), max(photo, other)))
    return best
