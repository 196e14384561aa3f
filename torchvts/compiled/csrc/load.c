/* A plan file, read and checked, and written: docs/plan.md states its layout. Nothing in it is believed: sizes of tables follow from the numbers of a plan, which
   have ranges; every value is finite; every index lies in the image. */
#include "load.h"

#include <stdarg.h>
#include <stdio.h>

#define TEXT(x) #x
#define INTEGER_TEXT(name, least, most) "i " #name " 1\n"
#define REAL_TEXT(name, least) "d " #name " 1\n"
#define TABLE_TEXT(type, name, values) TEXT(type) " " #name " " #values "\n"
#define OPTION_TEXT(type, name, values) TEXT(type) " " #name " " #values " or 0\n"

/* A line for each field of a plan, in their order: its kind (i int64, d double, else the type of a table), its name, and how many values it has. */
EXPORT const char *plan_fields(void) { return ALL_FIELDS(INTEGER_TEXT, REAL_TEXT, TABLE_TEXT, OPTION_TEXT); }

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "a plan is read in place, so its bytes must lie as the processor's");

enum { NUMBER, OF_FLOAT, OF_DOUBLE, OF_INT64_T, OF_UINT8_T };

/* Of numbers: whether whole, and their range; of tables: the type, and whether one may be missing. */
typedef struct {
    const char *name;
    size_t place; /* in a Plan */
    double least, most;
    int type, whole, may_miss;
} Field;

#define PLACE(name) #name, offsetof(Plan, name)
#define INTEGER_ROW(name, least, most) {PLACE(name), least, most, NUMBER, 1, 0},
#define REAL_ROW(name, least) {PLACE(name), least, 1e12, NUMBER, 0, 0},
#define TABLE_ROW(type, name, values) {PLACE(name), 0, 0, _Generic((type){0}, float: OF_FLOAT, double: OF_DOUBLE, int64_t: OF_INT64_T, uint8_t: OF_UINT8_T), 0, 0},
#define OPTION_ROW(type, name, values) {PLACE(name), 0, 0, _Generic((type){0}, float: OF_FLOAT, double: OF_DOUBLE, int64_t: OF_INT64_T, uint8_t: OF_UINT8_T), 0, 1},

static const Field FIELDS[] = {ALL_FIELDS(INTEGER_ROW, REAL_ROW, TABLE_ROW, OPTION_ROW)};
enum { COUNT = sizeof FIELDS / sizeof *FIELDS };

static const char KINDS[] = "nfdib"; /* of tables in a file: see Record */
static const size_t BYTES[] = {8, 4, 8, 8, 1};

typedef struct {
    char magic[8]; /* "VTSPLAN\n" */
    uint32_t version, checksum;
    uint64_t size;
    uint32_t fields, about;
    uint8_t zeros[32];
} Head;

typedef struct {
    char name[32];
    char kind; /* f float, d double, i int64, b bytes; a number is a table of one value */
    uint8_t zeros[7];
    uint64_t count;
    uint8_t more[16];
} Record;

_Static_assert(sizeof(Head) == LINE && sizeof(Record) == LINE, "both fill a line");

int refuse(char *reason, const char *format, ...) {
    va_list values;
    va_start(values, format);
    vsnprintf(reason, VTS_REASON, format, values);
    va_end(values);
    return 0;
}

/* CRC-32 as of zlib and PNG. */
static uint32_t checksum(const uint8_t *bytes, size_t size) {
    uint32_t table[256], sum = 0xffffffffu;
    for (uint32_t k = 0; k < 256; k++) {
        table[k] = k;
        for (int bit = 0; bit < 8; bit++) table[k] = table[k] >> 1 ^ (table[k] & 1 ? 0xedb88320u : 0);
    }
    for (size_t k = 0; k < size; k++) sum = sum >> 8 ^ table[(sum ^ bytes[k]) & 0xff];
    return ~sum;
}

static int check_head(const uint8_t *bytes, size_t size, char *reason) {
    Head head;
    if (size < sizeof head) return refuse(reason, "not a plan: %lu bytes are too few: cut short, or another file?", (unsigned long)size);
    memcpy(&head, bytes, sizeof head);
    if (memcmp(head.magic, "VTSPLAN\n", 8)) return refuse(reason, "not a plan: it does not begin as one; FrozenPipeline.save() writes them");
    if (head.version != PLAN_VERSION)
        return refuse(reason, "a plan of version %lu, and this library reads version %d: save it again with the torchvts of the library", (unsigned long)head.version,
                      PLAN_VERSION);
    if (head.size != size)
        return refuse(reason, "damaged: the plan should have %llu bytes, and has %lu: copy it again", (unsigned long long)head.size, (unsigned long)size);
    if (head.checksum != checksum(bytes + 16, size - 16)) return refuse(reason, "damaged: its bytes are not those that were written: copy the plan again");
    if (head.fields != COUNT)
        return refuse(reason, "a plan of %lu fields, and this library reads %d: save it again with the torchvts of the library", (unsigned long)head.fields, (int)COUNT);
    if (head.about == 0 || head.about > size - sizeof head || bytes[sizeof head + head.about - 1])
        return refuse(reason, "about: expected a text that ends with a zero within the file");
    return 1;
}

static char kind_of(const Field *field) { return field->type == NUMBER ? field->whole ? 'i' : 'd' : KINDS[field->type]; }

static size_t whole_lines(size_t bytes) { return (bytes + LINE - 1) / LINE * LINE; }

/* Reads the records: numbers into the plan, and where tables lie; count: values of each. */
static int read_records(const uint8_t *bytes, size_t size, size_t at, Plan *plan, uint64_t *count, char *reason) {
    for (int k = 0; k < COUNT; k++) {
        const Field *field = FIELDS + k;
        Record record;
        if (at > size || size - at < sizeof record) return refuse(reason, "%s: expected it in the plan, which ends before", field->name);
        memcpy(&record, bytes + at, sizeof record);
        at += sizeof record;
        if (strncmp(record.name, field->name, sizeof record.name)) return refuse(reason, "%s: expected it as field %d of the plan, got another", field->name, k);
        if (record.kind != kind_of(field)) return refuse(reason, "%s: expected values of kind %c, got others", field->name, kind_of(field));
        count[k] = record.count;
        if (record.count > (size - at) / BYTES[field->type]) return refuse(reason, "%s: expected %llu values, and the plan ends before", field->name, (unsigned long long)record.count);
        void *to = (char *)plan + field->place;
        const void *values = record.count ? bytes + at : NULL;
        if (field->type == NUMBER && record.count != 1) return refuse(reason, "%s: expected one number, got %llu", field->name, (unsigned long long)record.count);
        if (field->type == NUMBER) memcpy(to, values, 8);
        else memcpy(to, &values, sizeof values);
        at += whole_lines((size_t)record.count * BYTES[field->type]);
    }
    return at == size ? 1 : refuse(reason, "damaged: more follows the last field of the plan");
}

static int check_ranges(const Plan *plan, char *reason) {
    for (int k = 0; k < COUNT; k++) {
        const Field *field = FIELDS + k;
        int64_t whole;
        double real;
        if (field->type != NUMBER) continue;
        memcpy(&whole, (const char *)plan + field->place, sizeof whole), memcpy(&real, &whole, sizeof real);
        const double value = field->whole ? (double)whole : real;
        if (!(value >= field->least && value <= field->most))
            return refuse(reason, "%s: expected a number from %g to %g, got %g", field->name, field->least, field->most, value);
    }
    return 1;
}

/* What numbers must be to one another, so that no stage leaves its memory. */
static int check_rules(const Plan *p, char *reason) {
    const int64_t shorter = p->height < p->width ? p->height : p->width, reach = p->relight_stride / 2 + (p->relight_stride >= 3);
    const int64_t cells = ROWS(contact_cell) * COLUMNS(contact_cell), cubes = p->terms >= 13;
    const struct {
        int good;
        const char *rule;
    } rules[] = {
        {PIXELS <= MOST_PIXELS, "height, width: expected at most 2^26 pixels"},
        {poisson_size((int)p->height) > 0, "height: it has a prime factor above 64, for which there is no fast cosine transform"},
        {markers_fit(p), "marker_diameter: expected markers smaller than the image"},
        {p->marker_margin <= 2.0, "marker_margin: expected at most 2 diameters"},
        {p->lights != 1, "lights: expected none, or two or more"},
        {p->blur_taps % 2 || !p->blur_taps, "blur_taps: expected an odd number, or 0"},
        {p->mask_taps % 2 && p->contact_taps % 2, "mask_taps, contact_taps: expected odd numbers"},
        {p->defects < PIXELS, "defects: expected fewer than pixels"},
        {!p->relights || ((p->relight_rows - 1) * p->relight_stride + reach < p->height && (p->relight_columns - 1) * p->relight_stride + reach < p->width),
         "relight_rows, relight_columns: expected samples within the image"},
        {SAMPLES <= p->relight_padded && p->relight_padded % 8 == 0, "relight_padded: expected a multiple of 8 that holds all samples"},
        {p->mask_cell <= shorter && p->zero_cell <= shorter && p->contact_cell <= shorter, "mask_cell, zero_cell, contact_cell: expected cells within the image"},
        {p->by_lights || p->degree == 2 || p->degree == 4 || p->degree == 6, "degree: expected 2, 4 or 6"},
        {p->by_lights || p->terms - 10 * cubes == 3 || p->terms - 10 * cubes == 9, "terms: expected 3, 9, 13 or 19"},
        {p->passes == 1 || p->by_lights || p->per_mm, "passes: expected one, because the response does not depend on depth"},
        {p->contact_steps < 3 * cells, "contact_steps: expected fewer than three times the cells"},
        {p->large <= 1.0, "large: expected a share, at most 1"},
    };
    for (size_t k = 0; k < sizeof rules / sizeof *rules; k++)
        if (!rules[k].good) return refuse(reason, "%s", rules[k].rule);
    return 1;
}

#define NUMBER_SIZE(...) 1,
#define TABLE_SIZE(type, name, values) values,

static int check_sizes(const Plan *p, const uint64_t *count, char *reason) {
    const int64_t sizes[] = {ALL_FIELDS(NUMBER_SIZE, NUMBER_SIZE, TABLE_SIZE, TABLE_SIZE)};
    for (int k = 0; k < COUNT; k++)
        if (count[k] != (uint64_t)sizes[k] && (count[k] || !FIELDS[k].may_miss))
            return refuse(reason, "%s: expected %lld values for a plan of %lld x %lld pixels, got %llu", FIELDS[k].name, (long long)sizes[k], (long long)p->height,
                          (long long)p->width, (unsigned long long)count[k]);
    return 1;
}

static int all_finite(const void *table, int type, uint64_t count) {
    if (type == OF_FLOAT) {
        float ends[2] = {0.0f, 0.0f};
        if (count) range(table, (size_t)count, ends);
        return isfinite(ends[0]) && isfinite(ends[1]);
    }
    for (uint64_t k = 0; type == OF_DOUBLE && k < count; k++)
        if (!isfinite(((const double *)table)[k])) return 0;
    return 1;
}

static int all_within(const int64_t *table, int64_t count, int64_t end) {
    for (int64_t k = 0; k < count; k++)
        if (table[k] < 0 || table[k] >= end) return 0;
    return 1;
}

static int check_values(const Plan *p, const uint64_t *count, char *reason) {
    for (int k = 0; k < COUNT; k++) {
        const void *table;
        memcpy(&table, (const char *)p + FIELDS[k].place, sizeof table);
        if (!all_finite(table, FIELDS[k].type, count[k])) return refuse(reason, "%s: expected finite values, got NaN or infinity", FIELDS[k].name);
    }
    if (!all_within(p->defect, p->defects, PIXELS)) return refuse(reason, "defect: expected pixels of the image");
    if (!all_within(p->neighbours, 4 * p->defects, PIXELS)) return refuse(reason, "neighbours: expected pixels of the image");
    return 1;
}

int read_plan(const uint8_t *bytes, size_t size, Plan *plan, size_t *about_size, char *reason) {
    uint64_t count[COUNT];
    Head head;
    if (!check_head(bytes, size, reason)) return 0;
    memcpy(&head, bytes, sizeof head);
    *about_size = head.about - 1;
    return read_records(bytes, size, sizeof head + whole_lines(head.about), plan, count, reason) && check_ranges(plan, reason) && check_rules(plan, reason) &&
           check_sizes(plan, count, reason) && check_values(plan, count, reason);
}

uint8_t *write_plan(const Plan *p, const char *about, size_t about_size, size_t *size) {
    const int64_t sizes[] = {ALL_FIELDS(NUMBER_SIZE, NUMBER_SIZE, TABLE_SIZE, TABLE_SIZE)};
    const void *values[COUNT];
    Head head = {"VTSPLAN\n", PLAN_VERSION, 0, sizeof head + whole_lines(about_size + 1), COUNT, (uint32_t)about_size + 1, {0}};
    for (int k = 0; k < COUNT; k++) {
        values[k] = (const char *)p + FIELDS[k].place;
        if (FIELDS[k].type != NUMBER) memcpy(values + k, values[k], sizeof values[k]);
        head.size += sizeof(Record) + (values[k] ? whole_lines((size_t)sizes[k] * BYTES[FIELDS[k].type]) : 0);
    }
    uint8_t *bytes = calloc(1, (size_t)head.size), *to = bytes;
    if (!bytes) return NULL;
    memcpy(bytes + sizeof head, about, about_size);
    to += sizeof head + whole_lines(about_size + 1);
    for (int k = 0; k < COUNT; k++) {
        Record record = {.kind = kind_of(FIELDS + k), .count = values[k] ? (uint64_t)sizes[k] : 0};
        const size_t length = (size_t)record.count * BYTES[FIELDS[k].type];
        memcpy(record.name, FIELDS[k].name, strlen(FIELDS[k].name));
        memcpy(to, &record, sizeof record), to += sizeof record;
        if (length) memcpy(to, values[k], length);
        to += whole_lines(length);
    }
    memcpy(bytes, &head, sizeof head);
    head.checksum = checksum(bytes + 16, (size_t)head.size - 16);
    memcpy(bytes, &head, sizeof head);
    *size = (size_t)head.size;
    return bytes;
}
