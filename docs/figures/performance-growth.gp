# Draws the growth of costs: gnuplot -e "data='FILE'; picture='FILE'" performance-growth.gp
# Columns of the data, apart by tabs: what grows, its size, wall clock [s], processor time [s].

set terminal svg size 1500,470 font 'sans-serif,13' background '#ffffff'
set output picture
set datafile separator '\t'
set multiplot

set tics out nomirror font ',11'
set border 3
set grid ytics linecolor '#dddddd'
set ylabel font ',12' offset 1.2,0
set xlabel font ',12' offset 0,0.4
set title font ',14' offset 0,-0.4
set key top left reverse Left font ',12'
set label 1 'Cost of a fit of four models to one channel of 500 samples, and how it grows; medians' at screen 0.5,0.95 center font ',17'

wall = "linewidth 2 pointtype 7 pointsize 0.7 linecolor '#2171b5'"
processor = "linewidth 2 pointtype 6 pointsize 0.7 linecolor '#d95f02'"
panel(what) = sprintf("< awk -F'\\t' '$1 == \"%s\"' %s", what, data)
place(i) = 0.055 + i * 0.195

do for [i = 0:4] {
    what = word('samples channels models requests effort', i + 1)
    set lmargin at screen place(i)
    set rmargin at screen place(i) + 0.145
    set bmargin at screen 0.16
    set tmargin at screen 0.80
    set title word('Samples Channels Models Requests Effort', i + 1)
    set ylabel i == 0 ? 'seconds' : ''
    unset logscale
    set xtics auto
    set format x '%g'
    set xrange [0:*]
    set yrange [0:*]
    if (what eq 'samples') {
        set logscale xy
        set format x '10^{%T}'
        set format y '10^{%T}'
        set xrange [20:200000]
        set yrange [*:*]
        set xlabel 'in the channel'
    } else {
        set format y '%g'
        set xlabel word('- channels models requests -', i + 1)
    }
    if (what eq 'channels') { set xlabel 'of 500 samples' }
    if (what eq 'models') { set xlabel 'phong, ward, lafortune, he\_torrance'; set xtics 1; set xrange [0.5:4.5] }
    if (what eq 'requests') { set xlabel 'at once' }
    if (what eq 'effort') {
        set xlabel ' '
        set xrange [-0.5:2.5]
        plot panel(what) using 0:3:xtic(2) with linespoints @wall title 'wall clock', '' using 0:4 with linespoints @processor title 'processor'
    } else {
        plot panel(what) using 2:3 with linespoints @wall title 'wall clock', '' using 2:4 with linespoints @processor title 'processor'
    }
    unset label 1
    unset key
}
unset multiplot
