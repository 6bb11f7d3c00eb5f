# Draws time against distance to the best known: gnuplot -e "data='FILE'; picture='FILE'" trade-effort.gp
# Columns of the data, apart by tabs: model, effort, precision, processor time [ms], worst distance.

set terminal svg size 1500,520 font 'sans-serif,13' background '#ffffff'
set output picture
set datafile separator '\t'
set multiplot

set tics out nomirror font ',11'
set border 3
set grid xtics ytics linecolor '#dddddd'
set logscale xy
set format x '%g'
set format y '10^{%T}'
set xrange [0.3:300]
set yrange [3e-14:10]
set xlabel 'processor time of a fit, ms' font ',12' offset 0,0.4
set ylabel font ',12' offset 1,0
set title font ',14' offset 0,-0.4
set label 1 'A point is a dataset: median time, and the worst distance of its seeds to the best known loss' at screen 0.5,0.96 center font ',17'
set label 2 'within 1e-3: a success' at graph 0.98,first 2.2e-3 right font ',10' textcolor '#777777'
set arrow 1 from graph 0,first 1e-3 to graph 1,first 1e-3 nohead linecolor '#777777' dashtype 2

models = '"phong" "ward" "lafortune (2)" "he_torrance"'
efforts = 'draft standard thorough'
precisions = '"auto" "double" "single" "single alone"'
colour(i) = word("#d95f02 #2171b5 #238b45", i)
point(j) = int(word("7 6 2 1", j))
points(m, e, p) = sprintf("< awk -F'\\t' '$1 == \"%s\" && $2 == \"%s\" && $3 == \"%s\"' %s", m, e, p, data)

do for [k = 1:4] {
    set lmargin at screen 0.055 + (k - 1) * 0.24
    set rmargin at screen 0.055 + (k - 1) * 0.24 + 0.19
    set bmargin at screen 0.25
    set tmargin at screen 0.84
    name = word(models, k)
    set title name noenhanced
    set ylabel k == 1 ? 'loss over the best known, less 1' : ''
    unset key
    plot for [i = 1:3] for [j = 1:4] points(name, word(efforts, i), word(precisions, j)) using 4:5 with points \
        pointtype point(j) pointsize 0.9 linewidth 1.5 linecolor rgb colour(i)
    unset label 1
}
# The legend, in an empty plot below.
set lmargin at screen 0.05
set rmargin at screen 0.99
set bmargin at screen 0.01
set tmargin at screen 0.10
unset arrow 1
unset label 2
unset border
unset tics
unset grid
unset xlabel
unset ylabel
unset title
set key center center horizontal font ',12' maxrows 1 samplen 1 width -1
set logscale xy
plot for [i = 1:3] NaN with points pointtype 7 pointsize 0.9 linecolor rgb colour(i) title word(efforts, i), \
    for [j = 1:4] NaN with points pointtype point(j) pointsize 0.9 linewidth 1.5 linecolor rgb '#444444' title 'precision '.word(precisions, j)
unset multiplot
