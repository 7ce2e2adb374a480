// SPDX-License-Identifier: Apache-2.0
// Elimination of blocks of unknowns from whitened rows, the innermost blocks first, see
// loopcal.engine.eliminate_blocks.
//
// The rows of a block are [own | those of its ancestors | A | r]. ROWS of them at a time are
// reflected into a triangle of its own columns (fold.h); what the reflections leave are rows of the
// parent, and those of blocks without a parent are folded into the factor of [A | r]. So each row
// passes from its block to the machine while it is in the cache, and nothing else is kept. Of many
// rows, those of the machine are dealt to PARTS factors, ROWS at a time, with a lane for each part.
#pragma once

#include "fold.h"
#include "interface.h"

namespace INSTRUCTION_SET {

// Blocks of all structures in one list: their children, and the rows of each.
struct BlockLists {
    const loopcal::BlockStructure *structures;
    const loopcal::BlockRows *parts;
    int64_t count, pieces, blocks, rows;
    int64_t *first_block;               // of each structure
    int64_t *first_child, *child;       // of each block, the last list of blocks without a parent
    int64_t *first_row, *part, *number;  // of each block: its sets of rows, as parts and numbers

    static size_t need(int64_t count, int64_t blocks, int64_t rows) {
        return Arena::need<int64_t>(count + 1) + Arena::need<int64_t>(blocks + 2) + Arena::need<int64_t>(blocks) +
               Arena::need<int64_t>(blocks + 1) + 2 * Arena::need<int64_t>(rows);
    }

    void list(Arena &arena) {
        first_block = arena.take<int64_t>(count + 1);
        first_child = arena.take<int64_t>(blocks + 2), child = arena.take<int64_t>(blocks);
        first_row = arena.take<int64_t>(blocks + 1);
        part = arena.take<int64_t>(rows), number = arena.take<int64_t>(rows);
        first_block[0] = 0;
        for (int64_t s = 0; s < count; s++) first_block[s + 1] = first_block[s] + structures[s].count;
        std::memset(first_child, 0, sizeof(int64_t) * (size_t)(blocks + 2));
        std::memset(first_row, 0, sizeof(int64_t) * (size_t)(blocks + 1));
        // each list is counted, then filled from its end
        for (int pass = 0; pass < 2; pass++) {
            for (int64_t s = count - 1; s >= 0; s--)
                for (int64_t i = structures[s].count - 1; i >= 0; i--) {
                    int64_t parent = blocks;
                    if (structures[s].parent >= 0)
                        parent = first_block[structures[s].parent] + structures[s].parent_place[i];
                    if (pass) child[--first_child[parent]] = first_block[s] + i;
                    else first_child[parent]++;
                }
            for (int64_t p = pieces - 1; p >= 0; p--)
                for (int64_t i = parts[p].count - 1; i >= 0; i--) {
                    int64_t block = first_block[parts[p].structure] + parts[p].place[i];
                    if (pass) part[--first_row[block]] = p, number[first_row[block]] = i;
                    else first_row[block]++;
                }
            if (pass) continue;
            for (int64_t i = 0; i <= blocks; i++) first_child[i + 1] += first_child[i];
            for (int64_t i = 0; i < blocks; i++) first_row[i + 1] += first_row[i];
        }
        first_child[blocks + 1] = blocks;
    }
};

// The block at one depth of which rows arrive; at depth 0 the machine, all of whose columns are own.
struct ArrivingRows {
    double *triangle, *block;  // (own, width), (ROWS, width)
    int64_t own, columns, width, filled;
    bool is_begun;

    void begin(int64_t own_columns, int64_t all) {
        own = own_columns, columns = all, width = padded(all), filled = 0, is_begun = false;
        std::memset(triangle, 0, sizeof(double) * (size_t)(own * width));
        std::memset(block, 0, sizeof(double) * (size_t)(ROWS * width));
    }
};

// Factors of the rows of the machine by parts, folded together in the end.
class DealtRows {
  public:
    DealtRows(Arena &arena, int64_t p) : p_(p) {
        factor_ = arena.take<Lanes>(CHUNKS * packed(p, p)), block_ = arena.take<Lanes>(CHUNKS * p * ROWS);
        parts_ = arena.take<double>(PARTS * p * p);
    }

    static size_t need(int64_t p) {
        return Arena::need<Lanes>(CHUNKS * packed(p, p)) + Arena::need<Lanes>(CHUNKS * p * ROWS) +
               Arena::need<double>(PARTS * p * p);
    }

    void begin() {
        part_ = 0;
        for (int64_t i = 0; i < CHUNKS * packed(p_, p_); i++) factor_[i] = Lanes{};
        for (int64_t i = 0; i < CHUNKS * p_ * ROWS; i++) block_[i] = Lanes{};
    }

    // block : (ROWS, width), the rows of the next part
    void deal(const double *block, int64_t width) {
        Lanes *to = block_ + part_ / W * p_ * ROWS;
        for (int64_t j = 0; j < p_; j++)
            for (int i = 0; i < ROWS; i++) to[j * ROWS + i][part_ % W] = block[i * width + j];
        if (++part_ == PARTS) fold();
    }

    // The factors (PARTS, p, p).
    const double *finish() {
        if (part_) fold();
        for (int64_t c = 0; c < CHUNKS; c++) {
            int64_t count = PARTS - c * W < W ? PARTS - c * W : W;
            store_factors(factor_ + c * packed(p_, p_), count, p_, parts_ + c * W * p_ * p_);
        }
        return parts_;
    }

  private:
    static constexpr int64_t CHUNKS = (PARTS + W - 1) / W;

    void fold() {
        for (int64_t c = 0; c < CHUNKS; c++) fold_block(factor_ + c * packed(p_, p_), block_ + c * p_ * ROWS, p_);
        for (int64_t i = 0; i < CHUNKS * p_ * ROWS; i++) block_[i] = Lanes{};
        part_ = 0;
    }

    int64_t p_, part_ = 0;
    Lanes *factor_, *block_;
    double *parts_;
};

INLINE const double *find_row(const loopcal::Strided &rows, int64_t trial, int64_t row) {
    return rows.data + trial * rows.trial + row * rows.pose;
}

class BlockElimination {
  public:
    BlockElimination(const BlockLists &all, int64_t right, double limit, Arena &arena, int64_t depths,
                     int64_t own, int64_t columns)
        : lists_(all), right_(right), limit_(limit) {
        at_ = arena.take<ArrivingRows>(depths);
        for (int64_t d = 0; d < depths; d++) {
            int64_t kept = d ? own : right;
            at_[d].triangle = arena.take<double>(kept * padded(columns));
            at_[d].block = arena.take<double>(ROWS * padded(columns));
        }
        growth_ = arena.take<double>(own);
    }

    static size_t need(int64_t depths, int64_t own, int64_t columns, int64_t right) {
        return Arena::need<ArrivingRows>(depths) + depths * Arena::need<double>(ROWS * padded(columns)) +
               Arena::need<double>(right * padded(columns)) +
               (depths - 1) * Arena::need<double>(own * padded(columns)) + Arena::need<double>(own);
    }

    // length : of the columns of all unknowns. False where a block is not certainly of full rank.
    // dealt : for many rows, or null.
    bool run(int64_t trial, const double *length, double *factor, double *explained, DealtRows *dealt) {
        trial_ = trial, length_ = length, explained_ = 0.0, is_regular_ = true, dealt_ = dealt;
        at_[0].begin(right_, right_);
        if (dealt) dealt->begin();
        eliminate_children(lists_.blocks, 0);
        if (at_[0].filled) fold(0);
        if (dealt) {
            const double *rows = dealt->finish();
            dealt_ = nullptr;
            for (int64_t i = 0; i < PARTS * right_; i++) append(0, rows + i * right_, right_);
            if (at_[0].filled) fold(0);
        }
        for (int64_t i = 0; i < right_; i++)
            for (int64_t j = 0; j < right_; j++)
                factor[i * right_ + j] = j < i ? 0.0 : at_[0].triangle[i * at_[0].width + j];
        *explained = explained_;
        return is_regular_;
    }

  private:
    void eliminate_children(int64_t block, int64_t depth) {
        for (int64_t i = lists_.first_child[block]; i < lists_.first_child[block + 1] && is_regular_; i++)
            eliminate(lists_.child[i], depth + 1);
    }

    void eliminate(int64_t block, int64_t depth) {
        int64_t s = 0;
        while (block >= lists_.first_block[s + 1]) s++;
        const loopcal::BlockStructure &of = lists_.structures[s];
        int64_t place = block - lists_.first_block[s], columns = of.width + right_;
        at_[depth].begin(of.own, columns);
        for (int64_t i = lists_.first_row[block]; i < lists_.first_row[block + 1]; i++) {
            const loopcal::BlockRows &part = lists_.parts[lists_.part[i]];
            for (int64_t k = 0; k < part.height; k++) append_row(depth, part, lists_.number[i], k, of.width);
        }
        eliminate_children(block, depth);
        if (at_[depth].filled) fold(depth);
        if (is_regular_) finish(of, place, at_[depth]);
    }

    void append_row(int64_t depth, const loopcal::BlockRows &part, int64_t set, int64_t k, int64_t width) {
        ArrivingRows &at = at_[depth];
        double *out = at.block + at.filled * at.width;
        const double *from = find_row(part.by_unknowns, trial_, set * part.height + k);
        const int64_t *column = part.columns + set * part.used;
        for (int64_t c = 0; c < part.used; c++)
            if (column[c] < width) out[column[c]] = from[c];
        const double *right = find_row(part.machine, trial_, set * part.height + k);
        std::memcpy(out + width, right, sizeof(double) * (size_t)right_);
        if (++at.filled == ROWS) fold(depth);
    }

    void append(int64_t depth, const double *row, int64_t columns) {
        ArrivingRows &at = at_[depth];
        std::memcpy(at.block + at.filled * at.width, row, sizeof(double) * (size_t)columns);
        if (++at.filled == ROWS) fold(depth);
    }

    void fold(int64_t depth) {
        ArrivingRows &at = at_[depth];
        int64_t height = at.filled, begun = at.is_begun ? 0 : height < at.own ? height : at.own;
        const bool is_dealt = dealt_ && !depth;
        if (is_dealt) dealt_->deal(at.block, at.width);
        else fold_block_by_columns(at.triangle, at.block, at.own, at.width, begun);
        at.is_begun = !is_dealt, at.filled = 0;
        for (int64_t i = begun; depth && i < height; i++)
            append(depth - 1, at.block + i * at.width + at.own, at.columns - at.own);
        std::memset(at.block, 0, sizeof(double) * (size_t)(ROWS * at.width));
    }

    // Solve for the own columns; the singular values of their triangle, in columns of these lengths,
    // are certainly above the limit where its growth (triangles.h) is low.
    void finish(const loopcal::BlockStructure &of, int64_t place, const ArrivingRows &at) {
        int64_t u = of.own, right = at.columns - u, first = trial_ * of.count + place;
        double *inverse = of.inverse + first * u * u, *x = of.solution + first * u * right, most = 0.0;
        const int64_t *path = of.path + place * of.width;
        for (int64_t i = u - 1; i >= 0; i--) {
            const double *row = at.triangle + i * at.width;
            double size = 1.0, pivot = row[i], *own = x + i * right, *unit = inverse + i * u;
            for (int64_t c = 0; c < right; c++) own[c] = row[u + c];
            for (int64_t c = 0; c < u; c++) unit[c] = c == i ? 1.0 : 0.0;
            for (int64_t j = i + 1; j < u; j++) {
                size += magnitude(row[j]) / length_[path[j]] * growth_[j];
                for (int64_t c = 0; c < right; c++) own[c] -= row[j] * x[j * right + c];
                for (int64_t c = j; c < u; c++) unit[c] -= row[j] * inverse[j * u + c];
            }
            for (int64_t c = 0; c < right; c++) own[c] /= pivot;
            for (int64_t c = i; c < u; c++) unit[c] /= pivot;
            growth_[i] = size / (magnitude(pivot) / length_[path[i]]);
            most = larger(most, growth_[i]);
            explained_ += row[at.columns - 1] * row[at.columns - 1];
        }
        is_regular_ = most * (double)u * limit_ < 1.0 && explained_ - explained_ == 0.0;
    }

    const BlockLists &lists_;
    int64_t right_, trial_ = 0;
    double limit_, explained_ = 0.0;
    const double *length_ = nullptr;
    bool is_regular_ = true;
    DealtRows *dealt_ = nullptr;
    ArrivingRows *at_;
    double *growth_;
};

// Length of the column of every unknown over all rows of a trial; 1 where it is zero.
inline void measure_columns(const BlockLists &all, int64_t trial, double *length, int64_t unknowns) {
    std::memset(length, 0, sizeof(double) * (size_t)unknowns);
    for (int64_t p = 0; p < all.pieces; p++) {
        const loopcal::BlockRows &part = all.parts[p];
        const loopcal::BlockStructure &of = all.structures[part.structure];
        for (int64_t row = 0; row < part.count * part.height; row++) {
            int64_t set = row / part.height;
            const int64_t *path = of.path + part.place[set] * of.width, *column = part.columns + set * part.used;
            const double *from = find_row(part.by_unknowns, trial, row);
            for (int64_t c = 0; c < part.used; c++)
                if (column[c] < of.width) length[path[column[c]]] += from[c] * from[c];
        }
    }
    for (int64_t i = 0; i < unknowns; i++) length[i] = length[i] > 0.0 ? root(length[i]) : 1.0;
}

// Best values (unknowns, right) of all unknowns, from the outermost inwards.
inline void substitute_blocks(const BlockLists &all, int64_t right, int64_t trial, double *values) {
    for (int64_t s = 0; s < all.count; s++) {
        const loopcal::BlockStructure &of = all.structures[s];
        int64_t above = of.width - of.own, width = above + right;
        const double *x = of.solution + trial * of.count * of.own * width;
        for (int64_t i = 0; i < of.count; i++) {
            const int64_t *path = of.path + i * of.width;
            for (int64_t k = 0; k < of.own; k++, x += width) {
                double *out = values + path[k] * right;
                for (int64_t c = 0; c < right; c++) out[c] = -x[above + c];
                for (int64_t j = 0; j < above; j++) {
                    const double *outer = values + path[of.own + j] * right;
                    for (int64_t c = 0; c < right; c++) out[c] -= x[j] * outer[c];
                }
            }
        }
    }
}

// right : columns of [A | r]. limit : share of the size of a column above which singular values must
// certainly be. factor : (t, right, right). values : (t, unknowns, right). length : (t, unknowns).
// explained, is_regular : (t,).
inline int eliminate_blocks(const loopcal::BlockStructure *structures, int64_t count,
                            const loopcal::BlockRows *parts, int64_t pieces, int64_t t, int64_t unknowns,
                            int64_t right, double limit, double *factor, double *values, double *length,
                            double *explained, int8_t *is_regular) {
    BlockLists all{structures, parts, count, pieces, 0, 0, nullptr, nullptr, nullptr, nullptr, nullptr, nullptr};
    int64_t own = 0, columns = right, height = 0;
    for (int64_t s = 0; s < count; s++) {
        all.blocks += structures[s].count;
        own = structures[s].own > own ? structures[s].own : own;
        columns = structures[s].width + right > columns ? structures[s].width + right : columns;
    }
    for (int64_t p = 0; p < pieces; p++) all.rows += parts[p].count, height += parts[p].count * parts[p].height;
    const bool is_dealt = height >= MANY * right;
    Arena memory(BlockLists::need(count, all.blocks, all.rows));
    Arena arena(BlockElimination::need(count + 1, own, columns, right));
    Arena of_parts(is_dealt ? DealtRows::need(right) : 0);
    if (!memory.ok() || !arena.ok() || !of_parts.ok()) return loopcal::NO_MEMORY;
    all.list(memory);
    BlockElimination elimination(all, right, limit, arena, count + 1, own, columns);
    DealtRows dealt(of_parts, is_dealt ? right : 0);
    for (int64_t i = 0; i < t; i++) {
        double *own_length = length + i * unknowns;
        measure_columns(all, i, own_length, unknowns);
        is_regular[i] = elimination.run(i, own_length, factor + i * right * right, explained + i,
                                        is_dealt ? &dealt : nullptr);
        if (is_regular[i]) substitute_blocks(all, right, i, values + i * unknowns * right);
    }
    return loopcal::DONE;
}

}  // namespace INSTRUCTION_SET
